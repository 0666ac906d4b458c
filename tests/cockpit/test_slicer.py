"""Files for 3D Slicer: a film's lines, read back as VTP and as a sequence of them."""

import re
import zipfile

import numpy as np
import pytest

from endopilot.cockpit.film import EVERY, Film, FilmFrame, write_film
from endopilot.vessels import mesh_process


@pytest.fixture
def film(world, navigation):
    """A wire that is pushed for half a second, in frames of 0.05 s."""
    frames = [FilmFrame(world.snapshot())]
    world.command(((10.0, 0.0),))
    for _ in range(10):
        world.advance()
        frames.append(FilmFrame(world.snapshot()))
    return Film(navigation, 0.5, "pushed", lambda: iter(frames))


def test_the_path_at_the_end_is_the_last_line_with_its_forces(film, tmp_path):
    write_film(film, tmp_path / "path.vtp")
    last = list(film.make())[-1].snapshot
    np.testing.assert_array_equal(mesh_process.read(str(tmp_path / "path.vtp"))["points"], last.nodes)


def test_a_sequence_holds_each_line_at_its_time(film, tmp_path):
    write_film(film, tmp_path / "wire.seq.mrb")
    shown = [frame.snapshot for frame in film.make()][::EVERY]
    with zipfile.ZipFile(tmp_path / "wire.seq.mrb") as archive:
        archive.extractall(tmp_path)
    listed = re.search(r'indexValues="([^"]*)"', (tmp_path / "Wire" / "Wire.mrml").read_text())[1]
    assert [float(each.partition(":")[2]) for each in listed.split(";")] == [each.time_s for each in shown]
    for number, each in enumerate(shown):
        read = mesh_process.read(str(tmp_path / "Wire" / "Data" / f"Wire_{number}.vtp"))
        np.testing.assert_array_equal(read["points"], each.nodes)
