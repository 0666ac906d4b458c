"""What Tab completes, by bash and fish themselves with the script that `endopilot completion` prints."""

import shutil
import subprocess
import sys

import pytest

ASK = 'source "$0"; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _endopilot; echo "${COMPREPLY[@]}"'


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    made = subprocess.run(
        [sys.executable, "-m", "endopilot.cli", "completion"], capture_output=True, text=True, check=True
    ).stdout
    file = tmp_path_factory.mktemp("completion") / "script"
    file.write_text(made)
    return file


@pytest.mark.skipif(shutil.which("fish") is None, reason="needs fish")
def test_tab_completes_in_fish():
    ask = f"{sys.executable} -m endopilot.cli completion fish | source; complete -C 'endopilot xray --show '"
    made = subprocess.run(["fish", "--no-config", "-c", ask], capture_output=True, text=True, check=True)
    assert made.stdout.split() == ["contrast", "dsa", "fluoroscopy", "roadmap"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (["endopilot", "na"], "navigate"),
        (["endopilot", "navigate", "patient", "--tar"], "--target"),
        (["endopilot", "xray", "--show", ""], "fluoroscopy contrast dsa roadmap"),
        (["endopilot", "navigate", "pat"], ""),  # bash goes on with files
    ],
)
def test_tab_completes(script, words, completed):
    made = subprocess.run(["bash", "-c", ASK, script, *words], capture_output=True, text=True, check=True)
    assert made.stdout.strip() == completed
