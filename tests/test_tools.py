"""The tools that read what a user names end as the commands do: an error is one line."""

import runpy
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parent.parent / "tools"


@pytest.fixture
def tool(monkeypatch, capsys):
    """Run a tool as Python does, but in this process. Return its exit code, and what it printed on stderr."""

    def run(name, *arguments):
        script = str(TOOLS / f"{name}.py")
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(script, run_name="__main__")
        return ended.value.code, capsys.readouterr().err

    return run


@pytest.mark.parametrize("name", ["fig2", "bench_reconstruction", "bench_viewer", "bench_detection"])
def test_a_missing_input_is_one_line(tool, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, said = tool(name, tmp_path / "nowhere")
    assert code == 1
    assert len(said.splitlines()) == 1, said
    assert said.startswith(f"{name}.py: ")
    assert not list(tmp_path.iterdir())


def test_a_demo_without_images_has_nothing_to_reconstruct(tool, tmp_path):
    (tmp_path / "log").mkdir()
    code, said = tool("bench_reconstruction", tmp_path)
    assert code == 1
    assert len(said.splitlines()) == 1
    assert "`objslam demo` without --boxes makes one" in said


def test_without_a_gpu_its_benchmark_says_so_in_one_line(monkeypatch, capsys):
    pytest.importorskip("torch")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["bench_gpu.py"])
    monkeypatch.syspath_prepend(str(TOOLS))
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(TOOLS / "bench_gpu.py"), run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out == "no GPU was measured: torch sees no CUDA device\n"
