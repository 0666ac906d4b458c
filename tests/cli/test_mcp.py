"""`endopilot mcp`, by the SDK's own client over standard input and output."""

from __future__ import annotations

import asyncio
import shutil
import sys

import pytest

pytest.importorskip("mcp", reason="the extra `mcp` is not installed")
from mcp import Client, StdioServerParameters, stdio_client

from endopilot.cli.mcp import server
from endopilot.errors import InputError


def asked(folder, *calls, over=None):
    """Return what a client is told: its tools, and a result for each call (a tool's name and arguments)."""

    async def talk():
        async with Client(over or server(folder)) as client:
            tools = (await client.list_tools()).tools
            return tools, [await client.call_tool(name, given) for name, given in calls]

    return asyncio.run(talk())


@pytest.fixture
def folder(vessel, tmp_path):
    shutil.copytree(vessel, tmp_path / "open" / "patient")
    shutil.copytree(vessel, tmp_path / "secret")
    (tmp_path / "open" / "link").symlink_to(tmp_path / "secret")
    return tmp_path / "open"


def test_ten_tools_have_typed_answers(folder) -> None:
    tools, (devices, vessels) = asked(
        folder, ("devices", {}), ("atlas", {"output": "drawn", "vessel": "rca", "count": 1})
    )
    assert len(tools) == 10 and all(tool.description and tool.output_schema for tool in tools)
    plan = next(tool for tool in tools if tool.name == "plan")
    assert plan.output_schema["properties"]["reached"]["type"] == "boolean"
    assert plan.input_schema["required"] == ["anatomy", "target", "output"]
    assert "X,Y,Z in LPS mm" in plan.input_schema["properties"]["target"]["description"]
    (rows,) = devices.structured_content.values()
    assert {"workhorse-014"} < {row["name"] for row in rows}
    ((row,),) = vessels.structured_content.values()
    assert row["patient"].startswith("drawn/") and (folder / row["patient"] / "anatomy.json").exists()


def test_an_assistant_plans_and_simulates_over_standard_streams(folder) -> None:
    line = StdioServerParameters(command=sys.executable, args=["-m", "endopilot.cli", "mcp", str(folder)])
    plan = {"anatomy": "patient", "target": "0,0,15", "output": "plan"}
    rollout = {"anatomy": "patient", "controls": "plan", "output": "rollout.csv"}
    _, (planned, driven) = asked(folder, ("plan", plan), ("simulate", rollout), over=stdio_client(line))
    assert planned.structured_content["reached"] and planned.structured_content["plan"] == "plan"
    assert driven.structured_content["deepest_tip_mm"] == pytest.approx(15.0, abs=3.0)
    assert (folder / "rollout.csv").exists()


def test_what_may_be_several_is_a_list(folder) -> None:
    bag = pytest.importorskip("rosbags.rosbag1", reason="the extra `ros` is not installed")
    with bag.Writer(folder / "my.bag"):
        pass
    topics = ["command=/drive", "tip=/tip"]
    several = {"logs": ["my.bag", "../secret/anatomy.json"], "anatomy": "patient", "output": "r.yaml"}
    tools, (replayed, calibrated) = asked(
        folder,
        ("replay", {"log": "my.bag", "anatomy": "patient", "output": "r", "topics": topics}),
        ("calibrate", several),
    )
    kinds = {tool.name: tool.input_schema["properties"] for tool in tools}
    assert kinds["replay"]["topics"]["type"] == kinds["anatomy"]["sources"]["type"] == "array"
    assert "my.bag" in replayed.content[0].text and "/drive" in replayed.content[0].text
    assert "logs: ../secret/anatomy.json leads out" in calibrated.content[0].text


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("xray", {"anatomy": "../secret", "output": "x.png"}, "leads out of the folder"),
        ("xray", {"anatomy": "link", "output": "x.png"}, "leads out of the folder"),
        ("replay", {"log": "/etc/passwd", "anatomy": "patient", "output": "r"}, "leads out of the folder"),
        ("plan", {"anatomy": "patient", "target": "vessel", "output": "../p"}, "leads out of the folder"),
        ("plan", {"anatomy": "patient", "target": "vessel", "output": "p", "device": "/etc/passwd"}, "leads out"),
        ("plan", {"anatomy": "patient", "target": "vessel", "output": "p", "catheter": ["/etc/passwd"]}, "leads out"),
        ("plan", {"anatomy": "patient", "target": 4, "output": "p"}, "'4'; the vessel has no such section"),
        ("plan", {"anatomy": "patient", "target": "vessel", "output": "p", "force": 1}, "force"),
        ("navigate", {"anatomy": "patient", "target": "vessel", "output": "p", "policy": "os:system"}, "choose from"),
        ("atlas", {"output": "p", "count": 0}, "give a whole number from 1 to"),
        ("anatomy", {"sources": [], "output": "p"}, "Missing from endopilot anatomy"),
        ("segment", {"volume": "none.nii.gz", "output": "m.nii.gz", "method": "os:system"}, "choose from"),
    ],
)
def test_bad_input_is_answered_in_a_line_and_writes_nothing(folder, name, given, said) -> None:
    before = sorted(folder.parent.rglob("*"))
    _, (result,) = asked(folder, (name, given))
    assert result.is_error and said in result.content[0].text
    assert str(folder) not in result.content[0].text
    assert sorted(folder.parent.rglob("*")) == before


def test_a_file_is_no_folder_to_serve(folder) -> None:
    with pytest.raises(InputError, match=r"anatomy.json: is no folder; give the one whose files"):
        server(folder / "patient" / "anatomy.json")
