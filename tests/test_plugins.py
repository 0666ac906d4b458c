"""What users add by name, and libraries that are not installed."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from endopilot import __version__
from endopilot.errors import InputError
from endopilot.extras import extra_named, what_is_missing
from endopilot.files import sha256
from endopilot.navigation.policies import POLICIES, make_policy
from endopilot.plugins import Registry

_MODULE = """
import my_helper

class Waits:
    def start(self, navigation, seed):
        pass
    def decide(self, observation):
        return my_helper.WAIT

class Halfway:
    def start(self, navigation, seed):
        pass

class Demanding(Waits):
    def __init__(self, model):
        pass

def made():
    return Waits()

number = 3
"""


@pytest.fixture
def my_module(tmp_path, monkeypatch) -> Path:
    """Write modules into the current directory, and forget them afterwards."""
    (tmp_path / "my_module.py").write_text(_MODULE)
    (tmp_path / "my_helper.py").write_text("WAIT = 0")
    (tmp_path / "broken.py").write_text("def :")
    (tmp_path / "lacking.py").write_text("import numpy\nimport no_such_library\n")
    (tmp_path / "failing.py").write_text("x = 1\nraise ValueError('no\\nmodel')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in ("my_module", "my_helper", "broken", "lacking", "failing"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("name", ["my_module:Waits", "my_module:made"])
def test_a_class_or_a_function_of_a_module_in_the_current_directory_makes_a_policy(my_module, name):
    policy = make_policy(name)
    assert type(policy).__name__ == "Waits" and policy.decide(None) == 0
    assert make_policy(name) is not policy


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("backward", "policy: 'backward'; choose from forward, .*, open-loop, or give MODULE:OBJECT"),
        ("my_module:", "policy: 'my_module:'; choose from"),
        ("my_module.py:Waits", "no module my_module.py .*; a module is named without .py: my_module:Waits"),
        ("../my_module:Waits", "choose from"),
        ("no_module:Waits", "policy: 'no_module:Waits': there is no module no_module in the current directory"),
        ("my_module.sub:Waits", "there is no module my_module.sub"),
        ("my_module:Wait", r"my_module.py holds no Wait; correct the name"),
        ("my_module:number", "is no class and no function"),
        ("my_module:Halfway", "policy: 'my_module:Halfway' has no decide; add it"),
        ("my_module:Demanding", "cannot be made without arguments .TypeError: .*'model'"),
        ("broken:Policy", "broken cannot be imported .SyntaxError: .*, broken.py line 1.; mend it"),
        ("lacking:Policy", "lacking cannot be imported .ModuleNotFoundError: .*'no_such_library', lacking.py line 2"),
        ("failing:Policy", "failing cannot be imported .ValueError: no model, failing.py line 2"),
    ],
)
def test_what_is_no_policy_is_refused_in_one_line(my_module, name, expected):
    with pytest.raises(InputError, match=expected) as refusal:
        make_policy(name)
    assert "\n" not in str(refusal.value)


def test_an_origin_changes_with_the_file_of_a_policy(my_module):
    assert POLICIES.origin("forward") == f"endopilot {__version__}"
    before = POLICIES.origin("my_module:Waits")
    assert before == f"my_module.py sha256:{sha256(my_module / 'my_module.py')}"
    (my_module / "my_module.py").write_text(_MODULE + "# more\n")
    assert POLICIES.origin("my_module:Waits") != before


def test_only_what_is_asked_for_is_imported():
    code = (
        "import sys\nfrom endopilot.navigation.policies import POLICIES\nPOLICIES.check('agent')\n"
        "assert 'endopilot.control.agent' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_shipped_object_that_is_missing_is_a_defect_and_no_bad_input():
    with pytest.raises(AttributeError):
        Registry("policy", {"gone": "endopilot.navigation.policy:Gone"}).load("gone")


_RUDE = """
import sys
from endopilot.navigation.policy import Decision

class Odd(BaseException):
    pass

class Waits:
    def start(self, navigation, seed):
        print("noise")
    def decide(self, observation):
        return Decision()

class Leaves(Waits):
    def __init__(self):
        sys.exit(0)

class Interrupts(Waits):
    def decide(self, observation):
        raise KeyboardInterrupt

class Throws(Waits):
    def start(self, navigation, seed):
        raise Odd("two\\nlines")
"""


@pytest.mark.parametrize(
    ("name", "said"), [("Leaves", "SystemExit: 0"), ("Interrupts", "KeyboardInterrupt"), ("Throws", "Odd: two lines")]
)
def test_whatever_a_policy_raises_names_the_policy(tmp_path, monkeypatch, capsys, name, said):
    (tmp_path / "rude.py").write_text(_RUDE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    try:
        with pytest.raises(InputError, match=f"policy: 'rude:{name}': .*{said}, rude.py line .*mend it"):
            policy = make_policy(f"rude:{name}")
            policy.start(None, 0)  # pyright: ignore[reportArgumentType]
            policy.decide(None)  # pyright: ignore[reportArgumentType]
    finally:
        sys.modules.pop("rude", None)
    assert capsys.readouterr().out == ""


HIDE = "import sys; sys.modules[{module!r}] = None\n"
"""Makes a process where importing a module fails as if it were not installed."""

WITHOUT = """
import runpy, sys

class Hidden:
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in {hidden}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hidden())
runpy.run_path({script!r}, run_name="__main__")
"""
"""Runs a script where some libraries cannot be imported."""


def run_without(module: str, code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", HIDE.format(module=module) + code], capture_output=True, encoding="utf-8", timeout=120
    )


@pytest.mark.parametrize(
    ("module", "extra"),
    [
        ("torch", "learn"),
        ("pyarrow", "learn"),
        ("gymnasium", "env"),
        ("pydicom", "imaging"),
        ("jinja2", "report"),
        ("distributed", "cluster"),
        ("highdicom", "dicom-seg"),
        ("stable_baselines3", "rl"),
    ],
)
def test_the_mend_names_the_extra(module: str, extra: str) -> None:
    missing = what_is_missing(ModuleNotFoundError(f"No module named {module!r}", name=module))
    assert missing is not None and missing.endswith(f"pip install 'endopilot[{extra}]'")


def test_a_defect_stays_a_defect() -> None:
    error = ModuleNotFoundError("No module named 'nonsense'", name="nonsense")
    assert what_is_missing(error) is None
    with pytest.raises(ModuleNotFoundError) as caught, extra_named("x"):
        raise error
    assert caught.value is error


def test_a_name_of_the_package_names_the_extra() -> None:
    result = run_without("torch", "import endopilot; endopilot.train")
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last == "ModuleNotFoundError: endopilot.train needs torch; install it with: pip install 'endopilot[learn]'"


def of_base_install() -> set[str]:
    """Return the distributions that `pip install endopilot` brings, by their normal names."""
    found: set[str] = set()
    waiting = ["endopilot"]
    while waiting:
        name = canonicalize_name(waiting.pop())
        if name not in found:
            found.add(name)
            needs = map(Requirement, metadata.requires(name) or ())
            waiting += [each.name for each in needs if each.marker is None or each.marker.evaluate({"extra": ""})]
    return found


def test_the_base_libraries_are_enough(tmp_path: Path) -> None:
    base = of_base_install()
    hidden = {
        module
        for module, owners in metadata.packages_distributions().items()
        if base.isdisjoint(map(canonicalize_name, owners))
    }
    assert {"torch", "pyarrow", "gymnasium", "pydicom", "pytest"} <= hidden and {"numpy", "scipy"}.isdisjoint(hidden)
    script = Path(__file__).parent / "e2e" / "installed.py"
    code = WITHOUT.format(hidden=hidden, script=str(script))
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
