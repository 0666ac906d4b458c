"""What users add by name, and libraries that are not installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from endopilot import __version__
from endopilot.errors import InputError
from endopilot.extras import extra_named, require_extras, what_is_missing
from endopilot.files import sha256
from endopilot.navigation.baseline_policies import Forward
from endopilot.navigation.policies import POLICIES, make_policy
from endopilot.plugins import Registry

_MODULE = """
import sys

import my_helper

class Waits:
    def start(self, navigation, seed):
        print("noise")
    def decide(self, observation):
        return my_helper.WAIT

class Halfway:
    def start(self, navigation, seed):
        pass

class Demanding(Waits):
    def __init__(self, model):
        pass

class Odd(BaseException):
    pass

class Leaves(Waits):
    def __init__(self):
        sys.exit(0)

class Interrupts(Waits):
    def decide(self, observation):
        raise KeyboardInterrupt

class Throws(Waits):
    def start(self, navigation, seed):
        super().start(navigation, seed)
        raise Odd("two\\nlines")

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


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Return a function that installs a package which offers some entry points."""

    def install(package: str, group: str, points: dict[str, str]) -> None:
        folder = tmp_path / package
        meta = folder / f"{package}-2.1.dist-info"
        meta.mkdir(parents=True)
        (meta / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 2.1\n")
        lines = [f"{name} = {value}" for name, value in points.items()]
        (meta / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]) + "\n")
        (folder / f"{package}_policies.py").write_text(
            "from endopilot.navigation.baseline_policies import Forward\nclass Pushes(Forward):\n    pass\n"
        )
        monkeypatch.syspath_prepend(folder)

    yield install
    for name in [name for name in sys.modules if name.endswith("_policies") and "." not in name]:
        del sys.modules[name]


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
    with pytest.raises(InputError, match=expected):
        make_policy(name)


def test_an_installed_package_offers_a_policy_by_a_name(installed):
    installed("pusher", "endopilot.policies", {"pusher": "pusher_policies:Pushes"})
    assert POLICIES.names() == (*POLICIES.shipped, "pusher")
    assert type(make_policy("pusher")).__name__ == "Pushes"
    assert POLICIES.origin("pusher") == "pusher 2.1"


def test_a_name_that_two_packages_offer_is_refused(installed):
    installed("first", "endopilot.policies", {"pusher": "first_policies:Pushes", "forward": "first_policies:Pushes"})
    installed("second", "endopilot.policies", {"pusher": "second_policies:Pushes"})
    with pytest.raises(InputError, match="'pusher' is offered by second and by first; uninstall all but one"):
        make_policy("pusher")
    with pytest.raises(InputError, match="'forward' is offered by endopilot and by first"):
        POLICIES.check("forward")
    assert isinstance(make_policy("first_policies:Pushes"), Forward)
    make_policy("spin")  # other names are not concerned


def test_an_entry_point_that_leads_nowhere_is_refused(installed):
    installed("astray", "endopilot.policies", {"astray": "astray_policies:Other", "bare": "astray_policies"})
    with pytest.raises(InputError, match=r"policy: 'astray': .*astray_policies.py holds no Other"):
        make_policy("astray")
    with pytest.raises(InputError, match="policy: 'bare'"):
        make_policy("bare")


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
        Registry("policy", {"gone": "endopilot.navigation.policy:Gone"}, "endopilot.none").load("gone")


@pytest.mark.parametrize(
    ("name", "said"), [("Leaves", "SystemExit: 0"), ("Interrupts", "KeyboardInterrupt"), ("Throws", "Odd: two lines")]
)
def test_whatever_a_policy_raises_names_the_policy(my_module, capsys, name, said):
    with pytest.raises(InputError, match=f"policy: 'my_module:{name}': .*{said}, my_module.py line .*mend it"):
        policy = make_policy(f"my_module:{name}")
        policy.start(None, 0)  # pyright: ignore[reportArgumentType]
        policy.decide(None)  # pyright: ignore[reportArgumentType]
    assert capsys.readouterr().out == ""


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
    code = "import sys; sys.modules['torch'] = None\nimport endopilot; endopilot.train"  # as if it were not installed
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8")
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last == "ModuleNotFoundError: endopilot.train needs torch; install it with: pip install 'endopilot[learn]'"


def test_all_extras_that_are_missing_are_named_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    present = {"learn": False, "env": True, "report": False}
    monkeypatch.setattr("endopilot.extras.extras_present", lambda: present)
    require_extras("env")
    with pytest.raises(InputError, match=r"pip install 'endopilot\[learn,report\]'$"):
        require_extras("learn", "env", "report")
