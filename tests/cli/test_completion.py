"""What Tab completes, by bash and fish themselves with the script that `endopilot completion` prints."""

import shutil
import subprocess
import sys

import pytest

from command import output_of

ASK = 'source "$0"; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _endopilot; echo "${COMPREPLY[@]}"'


@pytest.mark.skipif(shutil.which("fish") is None, reason="needs fish")
def test_tab_completes_in_fish():
    ask = f"{sys.executable} -m endopilot.cli completion fish | source; complete -C 'endopilot xray --show '"
    made = subprocess.run(["fish", "--no-config", "-c", ask], capture_output=True, text=True, check=True)
    assert made.stdout.split() == ["contrast", "dsa", "fluoroscopy", "roadmap"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_tab_completes(capsys, tmp_path):
    (tmp_path / "script").write_text(output_of(capsys, "completion"))
    for words, completed in (
        (["endopilot", "na"], "navigate"),
        (["endopilot", "navigate", "patient", "--tar"], "--target"),
        (["endopilot", "xray", "--show", ""], "fluoroscopy contrast dsa roadmap"),
        (["endopilot", "navigate", "patient", "--robot", ""], ""),  # bash goes on with files
    ):
        line = ["bash", "-c", ASK, tmp_path / "script", *words]
        assert subprocess.run(line, capture_output=True, text=True, check=True).stdout.strip() == completed
