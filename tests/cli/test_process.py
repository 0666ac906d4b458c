"""How commands end: one line and an exit code, whatever stops them, and no library's lines on the screen."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from endopilot.cli import main
from endopilot.cli.arguments import show
from endopilot.cli.process import EXIT_DEFECT, carry_out
from endopilot.errors import InputError, Remark

_SLOW = """
import os, signal, sys, threading, time
from pathlib import Path
from endopilot.cli import main, process
from endopilot.parallel import each
from endopilot.files import writing

def slow(item):
    with writing(item) as partial:
        partial.write_text("half")
        (item.parent / f"{item.name}.begun").touch()
        time.sleep(60)

def work():
    threading.Thread(target=time.sleep, args=(60,)).start()
    each("Work", [Path("a"), Path("b")], slow)

if __name__ == "__main__":
    process.own_streams()
    process.leave(process.carry_out("test", work))
"""


_IMPORTING = """
import os, signal, sys, time
from importlib.machinery import ExtensionFileLoader
from endopilot.cli.process import carry_out
import numpy

loading = ExtensionFileLoader.create_module.__code__, ExtensionFileLoader.exec_module.__code__

def work():
    import vtkmodules.vtkFiltersCore
    time.sleep(0.5)

def profile(frame, event, arg):
    global nested
    if event == "call" and frame.f_code.co_name == "_find_and_load":
        while frame is not None and frame.f_code not in loading:
            frame = frame.f_back
        nested += frame is not None
        if frame is not None and nested == at:
            os.kill(os.getpid(), getattr(signal, sys.argv[1]))

codes, at = [], 0
while 99 not in codes:
    at, nested = at + 1, 0
    if not (child := os.fork()):
        sys.setprofile(profile)
        code = carry_out("test", work)
        os._exit(code if nested >= at else 99)  # there is no such import
    codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(*codes)
"""


def made_of(cause: BaseException, error: BaseException) -> BaseException:
    error.__cause__ = cause
    return error


def raising(error: BaseException):
    def work() -> None:
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (InputError("a.nii: bad\nline; mend it"), 2, r"a.nii: bad\nline; mend it"),
        (MemoryError("Unable to allocate 14.6 TiB for an array"), 2, "14.6 TiB of memory are asked for"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: 12 bytes"), 2, "memory is used up"),
        (ValueError("Maximum allowed size exceeded"), 2, "memory is used up"),
        (ImportError("libvtkCommonCore.so: failed to map segment from shared object"), 2, "memory is used up"),
        (RuntimeError("can't start new thread"), 2, "memory is used up"),
        (OSError(12, "Cannot allocate memory"), 2, "memory is used up"),
        (Exception("Unknown error: Failed to launch worker thread: Resource temporarily unavailable"), 2, "memory is"),
        (
            made_of(MemoryError("std::bad_alloc"), InputError("a.nrrd: damaged; export it again")),
            2,
            "memory is used up",
        ),
        (OSError(28, "No space left on device", "x"), 2, "the disk is full"),
        (IsADirectoryError(21, "Is a directory", "x.csv"), 2, "x.csv: Is a directory; check the path"),
        (ModuleNotFoundError("no distributed", name="distributed"), 2, r"pip install 'endopilot[cluster]'"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (KeyError("a"), EXIT_DEFECT, "a defect of endopilot (KeyError: 'a', test_process.py line"),
    ],
)
def test_every_exception_ends_in_one_line(capsys, error, code, said):
    assert carry_out("test", raising(error)) == code
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("endopilot test: ") and said in captured.err
    assert len(captured.err.splitlines()) == 1
    if code == EXIT_DEFECT:
        record = Path(captured.err.split()[-1])
        assert "Traceback" in record.read_text() and "raise error" in record.read_text()
        record.unlink()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_in_one_line_even_where_a_library_turns_it_into_an_error(capsys, number):
    def work() -> None:
        try:
            os.kill(os.getpid(), number)
            time.sleep(5)
        except SystemExit as error:
            raise ImportError("half imported") from error

    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        assert carry_out("test", work) == 128 + number
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
    assert capsys.readouterr().err == f"endopilot test: {'interrupted' if number == signal.SIGINT else 'terminated'}\n"


def test_a_signal_while_vtk_is_imported_ends_in_one_line():
    """Send it at each of the imports that VTK's modules make while they are loaded, the second to the last one."""
    pytest.importorskip("vtkmodules")
    script = [sys.executable, "-c", _IMPORTING, "SIGTERM"]
    done = subprocess.run(script, capture_output=True, text=True, check=True)
    *stopped, finished = done.stdout.split()
    assert len(stopped) > 5 and set(stopped) == {str(128 + signal.SIGTERM)} and finished == "99"
    assert set(done.stderr.splitlines()) == {"endopilot test: terminated"}


@pytest.mark.parametrize(("number", "group"), [(signal.SIGINT, True), (signal.SIGTERM, False)])
def test_a_signal_leaves_no_process_and_no_half_written_file(tmp_path, number, group):
    (tmp_path / "slow.py").write_text(_SLOW)
    running = subprocess.Popen(
        [sys.executable, "slow.py"], cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    while not list(tmp_path.glob("*.begun")):
        assert running.poll() is None
        time.sleep(0.02)
    (os.killpg if group else os.kill)(running.pid, number)
    errors = running.communicate(timeout=30)[1]
    assert running.returncode == 128 + number
    assert errors == f"endopilot test: {'interrupted' if number == signal.SIGINT else 'terminated'}\n"
    assert not list(tmp_path.glob(".part-*"))
    end = time.monotonic() + 10
    while time.monotonic() < end:  # the resource tracker of multiprocessing ends a moment later
        try:
            os.killpg(running.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    raise AssertionError("a process is left")


@pytest.mark.parametrize("mib", [48, 260, 1030])
def test_a_limit_of_memory_ends_in_one_line(tmp_path, mib):
    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (mib << 20, mib << 20))

    command = [sys.executable, "-m", "endopilot.cli", "phantom", "patient", "-o", "ct.nrrd"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, preexec_fn=limited, timeout=60)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done
    if mib < 1024:
        assert done.stderr.startswith("endopilot phantom: memory: limited to ") and "raise the limit" in done.stderr


@pytest.mark.timeout(30)  # a FIFO that is opened hangs
@pytest.mark.parametrize(
    "given",
    [
        "anatomy odd.nii.gz",
        "anatomy odd.mrk.json",
        "segment odd",
        "simulate patient --controls odd.csv",
        "simulate patient --controls odd.npz",
        "simulate patient --device odd.yaml",
        "simulate patient --config odd.yaml",
        "plan patient --target odd.csv",
        "replay odd.csv --anatomy patient",
    ],
)
def test_what_is_no_file_is_refused(capsys, tmp_path, monkeypatch, given):
    monkeypatch.chdir(tmp_path)
    Path("patient").mkdir()
    odd = next(word for word in given.split() if word.startswith("odd"))
    os.mkfifo(odd)
    for arguments in ([*given.split(), "-o", "out"], ["phantom", "patient", "-o", odd]):
        with pytest.raises(SystemExit, match="2"):
            main(arguments)
        said = f"endopilot {arguments[0]}: {odd}: is a FIFO, a socket or a device; give a file or a folder\n"
        assert capsys.readouterr() == ("", said)
    assert {path.name for path in Path().iterdir()} == {odd, "patient"}


def test_a_name_that_is_not_utf_8_is_refused_in_one_line(tmp_path):
    name = b"v\xe9ssel.nii.gz"  # as Latin-1 has it
    (tmp_path / os.fsdecode(name)).touch()
    for arguments in ([b"anatomy", name, b"-o", b"out"], [b"atlas", b"-o", b"\xff"], [b"\xff"]):
        done = subprocess.run([sys.executable, "-m", "endopilot.cli", *arguments], cwd=tmp_path, capture_output=True)
        assert done.returncode == 2 and done.stdout == b"" and done.stderr.count(b"\n") == 1
        assert b": the name is not UTF-8; rename it" in done.stderr
    assert [os.fsencode(path.name) for path in tmp_path.iterdir()] == [name]


def test_our_remarks_are_shown_and_warnings_of_libraries_are_not(capsys):
    def work() -> None:
        warnings.warn("legend overflows", UserWarning, stacklevel=1)
        warnings.warn("1 of 2 worlds is invalid", Remark, stacklevel=1)

    assert carry_out("test", work) == 0
    assert capsys.readouterr().err == "endopilot test: 1 of 2 worlds is invalid\n"


def test_what_libraries_write_past_python_stays_off_the_screen():
    script = (
        "import os, subprocess\nfrom endopilot.cli import process\nprocess.own_streams()\n"
        "os.write(2, b'libEGL warning'); subprocess.run(['echo', 'loud']); print('{\"result\": \"\\udc80\"}')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ('{"result": "\\udc80"}\n', "loud\n")


@pytest.mark.parametrize("name", ["[/b]", "[red]", "a b", "*?"])
def test_odd_names_are_shown_as_they_are(capsys, name):
    show([{"patient": name}], as_json=False)
    show({"patient": f"{name}\n"}, as_json=False)
    assert capsys.readouterr().out.count(name) == 2
