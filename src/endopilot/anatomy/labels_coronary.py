"""AHA/SCCT segments of coronary trees, from where branches leave and where they go (see `labels`)."""

from __future__ import annotations

import numpy as np

from endopilot.anatomy.labels_tree import Labeller
from endopilot.types import Centerline

ACUTE_MARGIN = 0.64
"""The acute margin lies at this share of the path from the ostium to the crux (Dodge et al., Circulation
1988;78:1167-80, R2 distal); segment 1 ends halfway to it."""

USUAL_CRUX_MM, NEAREST_CRUX_MM = 140.0, 120.0  # path from ostium to crux; 122 to 170 in six patients
SHORT_MM = 60.0  # a coronary artery whose longest path is shorter than this is cut off, occluded, or a vestige
CRUX_FORK_MM = 25.0  # the fork at the crux lies within this much of the path from where the path passes the crux, mm
BEYOND_CRUX_MM, FORWARDS_MM = 15.0, 8.0  # beyond the crux, and turned forwards: a posterior descending
MAJOR_MM = 6.0  # a branch with at least this much length behind it counts as a named end vessel, mm
NAMED_MM = 15.0  # branches of the left main, and a ramus intermedius, have at least this much length behind them, mm

USUAL_LEFT_MAIN_MM, LONGEST_LEFT_MAIN_MM = 5.0, 30.0
"""Length of the left main: the median of sixteen real ones (5 to 95 %: 1 to 15 mm), and more than any has, mm."""

_EARLY, _LATE = 0.22, 0.4  # shares of the path to the crux: conus branches leave within one, sinus node's within two
_RAMUS_MM = 4.0  # where LAD and LCx divide so near the left main's end, the middle branch is the ramus

GROOVE = np.array([-0.7, 0.6, -0.3])
"""Direction (LPS) in which the circumflex's course round the left atrioventricular groove reaches farthest at its end,
the crux."""


def label_rca(labeller: Labeller) -> None:
    """Name the sections of a right coronary tree."""
    tree = labeller.tree
    leaf = tree.longest_leaf()
    route = tree.route(leaf)
    passed = None if labeller.crux is None else labeller.crux.abscissa(tree.path(leaf))
    crux = _crux(labeller, route) if labeller.crux is None else _crux_near(labeller, route, passed)
    beyond = "4"
    if crux is not None:
        end, trunk = float(tree.branches[crux].centerline.abscissa[-1]), tree.route(crux)
    elif labeller.crux is None:
        end, trunk = _unforked_crux(labeller, route), route
    else:
        end, trunk = _end_of_distal(tree.path(leaf), passed), route
        beyond = "4" if _turns_forwards(tree.path(leaf), end) else "16"
    margin = ACUTE_MARGIN * end
    labeller.along(trunk, [("1", margin / 2), ("2", margin), ("3", end), (beyond, np.inf)])
    if crux is not None:
        ends = sorted(tree.children(crux), key=lambda child: _towards_apex(labeller, child))
        for child in ends[:-1]:
            labeller.fill(child, "16")
        labeller.fill(ends[-1], "4")
    _label_right_sides(labeller, trunk, crux, end)


def _crux_near(labeller: Labeller, route: tuple[int, ...], passed: float | None) -> int | None:
    """Return the branch of a route that forks first near where the route passes the known crux, or None."""
    if passed is None:
        return None
    ends = {index: float(labeller.tree.branches[index].centerline.abscissa[-1]) for index in _forks(labeller, route)}
    return next((index for index, end in ends.items() if abs(end - passed) < CRUX_FORK_MM), None)


def _forks(labeller: Labeller, route: tuple[int, ...]) -> list[int]:
    return [branch for branch in route if len(labeller.major(branch, MAJOR_MM)) >= 2]


def _end_of_distal(line: Centerline, passed: float | None) -> float:
    """Return segment 3's end, mm, in an artery that does not fork at the crux, or ends on its usual way there."""
    whole = float(line.abscissa[-1])
    if passed is None:
        return max(whole, USUAL_CRUX_MM)
    return passed if whole - passed > BEYOND_CRUX_MM else whole


def _turns_forwards(line: Centerline, crux_mm: float, beyond_mm: float = 0.0) -> bool:
    """Return whether a vessel goes on beyond the crux for long enough and turns forwards, to the apex, there."""
    behind = line.points[line.abscissa >= crux_mm, 1]
    long = float(line.abscissa[-1]) - crux_mm >= beyond_mm
    return long and len(behind) > 0 and float(behind.max() - behind[-1]) > FORWARDS_MM


def _crux(labeller: Labeller, route: tuple[int, ...]) -> int | None:
    """Return the branch that ends at the crux: the first low fork into two branches after the turn to the back. Before
    the acute margin the vessel runs down and to the right; from there to the crux, to the left and the back."""
    back = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    height = labeller.tree.path(route[-1]).points[:, 2]
    low = height.min() + 0.4 * float(np.ptp(height))
    whole = float(labeller.tree.branches[route[-1]].centerline.abscissa[-1])
    for branch in _forks(labeller, route):
        line = labeller.tree.branches[branch].centerline
        late = float(line.abscissa[-1]) > 0.52 * whole
        if late and line.points[-1, 2] < low and float(labeller.arriving(branch) @ back) > -0.1:
            return branch
    return None


def _unforked_crux(labeller: Labeller, route: tuple[int, ...]) -> float:
    """Return where segment 3 ends, mm, in a tree whose end does not fork: where it turns forwards behind its most
    posterior point for long enough, as the posterior descending artery does, or at its end."""
    line = labeller.tree.path(route[-1])
    if line.abscissa[-1] < SHORT_MM:
        return USUAL_CRUX_MM
    later = np.flatnonzero(line.abscissa > 0.5 * line.abscissa[-1])
    turn = float(line.abscissa[later[line.points[later, 1].argmax()]])
    return turn if _turns_forwards(line, turn, BEYOND_CRUX_MM) else float(line.abscissa[-1])


def _towards_apex(labeller: Labeller, branch: int) -> float:
    """Tell how much a branch from the crux runs forwards and down to the apex, as the posterior descending does."""
    return float(labeller.heading(branch, 25.0) @ np.array([0.0, -1.0, -0.4]))


def _label_right_sides(labeller: Labeller, trunk: tuple[int, ...], crux: int | None, end: float) -> None:
    behind = labeller.tree.children(crux) if crux is not None else ()
    sides = [side for side in labeller.sides(trunk) if side not in behind]
    # The sinus node's branch runs back and up over the atrium, the others forwards over the right ventricle.
    atrial = np.array([-0.9, 1.45, 0.7])
    anterior = [
        side
        for side in sides
        if labeller.origin(side) > _LATE * end or float(labeller.heading(side, 20.0) @ atrial) < 0
    ]
    for side in sides:
        if side not in anterior:
            labeller.fill(side, "SA")
    first = next(iter(anterior), -1)
    conus = first if len(anterior) > 2 or labeller.origin(first) < _EARLY * end else -1
    ventricular = [side for side in anterior if side != conus]
    # Of the branches to the right ventricle, the acute marginal is the long and late one.
    marginal = max(
        ventricular,
        key=lambda side: labeller.origin(side) / (0.06 * end) + labeller.length_behind(side) / 9.0,
        default=-1,
    )
    for side in anterior:
        labeller.fill(side, "conus" if side == conus else "AM" if side == marginal else "RV")


def label_lca(labeller: Labeller) -> None:
    """Name the sections of a left coronary tree. Where the left main does not fork within `LONGEST_LEFT_MAIN_MM`, it
    has one main vessel: the anterior descending artery if it runs forwards, else the circumflex."""
    tree = labeller.tree
    fork = labeller.fork(0, NAMED_MM)
    major = labeller.major(fork, NAMED_MM)
    end = float(tree.branches[fork].centerline.abscissa[-1])
    if len(major) < 2 or end > LONGEST_LEFT_MAIN_MM:
        line = tree.path(tree.longest_leaf()).points
        far = line[np.linalg.norm(line - line[0], axis=1).argmax()] - line[0]
        (_label_lad if far[1] < 0 else _label_lcx)(labeller, 0, USUAL_LEFT_MAIN_MM)
        return
    trunk = tree.route(fork)
    labeller.along(trunk, [("5", np.inf)])
    for side in labeller.sides(trunk):
        labeller.fill(side, "5")
    towards_apex = np.array([0.3, -0.7, -0.6])
    lad = max(major, key=lambda child: labeller.reach(child, towards_apex))
    lcx = max((child for child in major if child != lad), key=lambda child: labeller.reach(child, GROOVE))
    for middle in major:
        if middle not in (lad, lcx):
            labeller.fill(middle, "17")
    _label_lad(labeller, lad, end)
    _label_lcx(labeller, lcx, end)


def _label_lad(labeller: Labeller, branch: int, end: float) -> None:
    tree = labeller.tree
    route = labeller.onwards(branch, tree.longest_leaf(branch))
    # Diagonals run to the left over the free wall; septals dive to the right of the vessel's own course.
    diagonals, named = [], []
    for side in labeller.sides(route):
        main = next(i for i in route if tree.branches[i].parent == tree.branches[side].parent)
        leftward = labeller.heading(side, 25.0) - labeller.heading(main, 25.0)
        if labeller.origin(side) - end < _RAMUS_MM and labeller.length_behind(side) > NAMED_MM:
            labeller.fill(side, "17")
            continue
        named.append(side)
        if leftward @ np.array([1.0, 0.2, 0.0]) > 0:
            diagonals.append(side)
        else:
            labeller.fill(side, "septal")
    for order, side in enumerate(diagonals):
        labeller.fill(side, ("9", "10")[order] if order < 2 else "D")
    line = tree.path(route[-1])
    own = np.flatnonzero(line.abscissa >= labeller.origin(branch))
    apex = own[np.linalg.norm(line.points[own] - line.points[own[0]], axis=1).argmax()]
    apex_mm = float(line.abscissa[apex])
    proximal = labeller.origin(named[0]) if named else end + (apex_mm - end) / 3
    labeller.along(route, [("5", end), ("6", proximal), ("7", 0.5 * (proximal + apex_mm)), ("8", np.inf)])


def _label_lcx(labeller: Labeller, branch: int, end: float) -> None:
    tree = labeller.tree
    # The circumflex keeps to the groove, round the back; the marginals leave it to the left.
    supplies = labeller.crux is not None and labeller.crux.dominance != "right"
    if labeller.crux is not None and supplies:
        crux = labeller.crux.position
        leaf = min(tree.leaves(branch), key=lambda i: np.linalg.norm(tree.path(i).points - crux, axis=1).min())
    else:
        leaf = max(tree.leaves(branch), key=lambda index: (tree.path(index).points @ GROOVE).max())
    route = labeller.onwards(branch, leaf)
    crux_mm = _left_crux(labeller, route)
    marginals = []
    for side in labeller.sides(route):
        if supplies and labeller.origin(side) > crux_mm - CRUX_FORK_MM and _towards_apex(labeller, side) > 0:
            labeller.fill(side, "15")
        elif labeller.origin(side) - end < _RAMUS_MM and labeller.length_behind(side) > NAMED_MM:
            labeller.fill(side, "17")
        else:
            marginals.append(side)
    for order, side in enumerate(marginals):
        labeller.fill(side, "12" if order == 0 else "14")
    tip = float(tree.branches[route[-1]].centerline.abscissa[-1])
    proximal = labeller.origin(marginals[0]) if marginals else end + 0.5 * (tip - end)
    labeller.along(route, [("5", end), ("11", proximal), ("13", crux_mm), ("15", np.inf)])


def _left_crux(labeller: Labeller, route: tuple[int, ...]) -> float:
    """Return where the circumflex becomes the left posterior descending, mm; infinity where it does not."""
    line = labeller.tree.path(route[-1])
    if labeller.crux is not None:
        passed = labeller.crux.abscissa(line)
        return np.inf if passed is None or labeller.crux.dominance == "right" else passed
    turn = float(line.abscissa[(line.points @ GROOVE).argmax()])
    return turn if _turns_forwards(line, turn, BEYOND_CRUX_MM) else np.inf
