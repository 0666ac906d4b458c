"""The policy that turns the wire as a network says, the network, and what it is given of a fork."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from endopilot.control.cloned import NETWORK, ClonedPolicy
from endopilot.control.turn_network import AZIMUTH, FEATURES, ForkView, TurnNetwork, fourier
from endopilot.devices.catheter import read_catheter
from endopilot.errors import InputError
from endopilot.navigation.loop import NavigationLoop
from endopilot.navigation.policy import Believer, Policy
from endopilot.tasks.navigation import Navigation, Target
from endopilot.tasks.route import Route
from endopilot.types import Anatomy, Branch

NODES = np.array([[0.4, 1.6, 16.0], [0.1, 0.6, 14.5], [0.0, 0.1, 12.0], [0.0, 0.0, 6.0], [0.0, 0.0, 0.0]])


def moved(anatomy: Anatomy, linear: np.ndarray) -> Anatomy:
    """Return an anatomy whose centerlines are moved by a linear map."""

    def line(branch: Branch) -> Branch:
        points, normals = branch.centerline.points @ linear.T, branch.centerline.normals @ linear.T
        return replace(branch, centerline=replace(branch.centerline, points=points, normals=normals))

    return replace(anatomy, tree=replace(anatomy.tree, branches=tuple(line(each) for each in anatomy.tree.branches)))


def seen(anatomy: Anatomy, nodes: np.ndarray, device) -> ForkView:
    route = Route.to(anatomy, Target(branch=2, abscissa=33.0))
    return ForkView.of(route, float(route.junctions[0]), nodes, device)


def test_a_fork_looks_the_same_wherever_it_lies(fork, shaped) -> None:
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    here, there = seen(fork, NODES, shaped), seen(moved(fork, turn), NODES @ turn.T, shaped)
    assert here.features.shape == (FEATURES,)
    np.testing.assert_allclose(there.features, here.features, atol=1e-9)
    assert there.azimuth == pytest.approx(here.azimuth, abs=1e-9)


def test_a_mirrored_fork_is_what_mirrored_says(fork, shaped) -> None:
    mirror = np.eye(3) - 2 * np.outer([0.6, 0.8, 0.0], [0.6, 0.8, 0.0])
    here, there = seen(fork, NODES, shaped).mirrored(), seen(moved(fork, mirror), NODES @ mirror.T, shaped)
    np.testing.assert_allclose(there.features, here.features, atol=1e-9)
    assert there.azimuth == pytest.approx(here.azimuth, abs=1e-9)


def test_turning_the_wire_turns_the_azimuth_as_much(fork, shaped) -> None:
    route = Route.to(fork, Target(branch=2, abscissa=33.0))
    at = float(route.junctions[0])
    along = route.position(at) - route.position(at - 2.0)
    straight = np.array([route.position(at - away) for away in (4.0, 5.0, 8.0, 12.0, 16.0, 30.0)])
    bent = straight + np.outer([2.0, 1.4, 0.2, 0.0, 0.0, 0.0], np.cross(along, [1.0, 0.0, 0.0]))
    turn = Rotation.from_rotvec(0.8 * along / np.linalg.norm(along)).as_matrix()
    before, after = (
        ForkView.of(route, at, nodes, shaped).azimuth
        for nodes in (bent, (bent - route.position(at)) @ turn.T + route.position(at))
    )
    assert np.angle(np.exp(1j * (after - before))) == pytest.approx(0.8, abs=1e-6)


def test_the_network_is_a_fourier_series_of_the_azimuth_averaged_with_its_mirror_image(fork, shaped, tmp_path) -> None:
    """Of constant logits b, passes = (σ(Σ bₖ fₖ(ψ)) + σ(Σ bₖ fₖ(−ψ))) / 2."""
    terms = np.array([0.3, 1.5, -0.7])
    nothing = np.zeros((1, FEATURES, 3))
    network = TurnNetwork(np.zeros(FEATURES), np.ones(FEATURES), ((nothing, terms[None]),))
    network.write(tmp_path / "turns.npz")
    passes = TurnNetwork.read(tmp_path / "turns.npz").passes(seen(fork, NODES, shaped))
    both = [1 / (1 + np.exp(-(0.3 + 1.5 * np.cos(side) - 0.7 * np.sin(side)))) for side in (AZIMUTH, -AZIMUTH)]
    np.testing.assert_allclose(passes, np.mean(both, axis=0), atol=1e-6)
    assert fourier(np.array([0.5]), 5)[0] == pytest.approx([1.0, np.cos(0.5), np.sin(0.5), np.cos(1.0), np.sin(1.0)])


def test_a_missing_network_is_one_line(tmp_path) -> None:
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    for name in ("none.npz", "bad.npz"):
        with pytest.raises(InputError, match=f"{name}: no network of turns"):
            TurnNetwork.read(tmp_path / name)


def test_the_network_says_where_a_branch_leaves(fork, shaped) -> None:
    """Towards the branch that is wanted the wire passes likelier than away from it."""
    passes = TurnNetwork.read(NETWORK).passes(seen(fork, NODES, shaped))
    towards, away = np.cos(AZIMUTH) > 0.8, np.cos(AZIMUTH) < -0.8
    assert passes[towards].mean() > passes[away].mean() + 0.2
    assert passes.min() >= 0 and passes.max() <= 1


@pytest.mark.parametrize("turn", [0.0, 2.0, 4.0])
def test_it_gets_into_a_side_branch_with_few_exposures(fork, shaped, turn) -> None:
    target = Target(branch=2, abscissa=33.0)
    navigation = Navigation(anatomy=fork, device=shaped, target=target, seconds=40.0, start_rotation_rad=turn)
    policy = ClonedPolicy()
    assert isinstance(policy, Policy) and isinstance(policy, Believer)
    record = NavigationLoop(navigation, policy, seed=1).run()
    assert record.success and record.safe
    assert record.exposures <= 15
    assert record.tip.branch[-1, 0] == 2


def test_it_gives_up_where_no_side_leads_on(fork, shaped) -> None:
    nowhere = TurnNetwork(np.zeros(FEATURES), np.ones(FEATURES), ((np.zeros((1, FEATURES, 1)), np.zeros((1, 1))),))
    straight = shaped.with_tip(bend_rad=0.0, stiffness_factor=1.0)
    navigation = Navigation(anatomy=fork, device=straight, target=Target(branch=2, abscissa=33.0), seconds=120.0)
    record = NavigationLoop(navigation, ClonedPolicy(nowhere), seed=1).run()
    assert not record.success and record.reason == "gave up"
    assert "no side that the tip points to leads past" in record.gives_up


def test_a_catheter_is_refused(fork, shaped) -> None:
    catheter = (read_catheter("microcatheter-1.7f"),)
    navigation = Navigation(anatomy=fork, device=shaped, target=Target(branch=2, abscissa=33.0), catheters=catheter)
    with pytest.raises(InputError, match="cloned drives a wire alone"):
        ClonedPolicy().start(navigation, seed=0)
