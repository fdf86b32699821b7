"""The notebooks of the documents run from top to bottom, and hold no output of another version."""

import warnings
from pathlib import Path

import pytest

nbclient = pytest.importorskip("nbclient", reason="needs nbclient and ipykernel, which the extra test installs")
pytest.importorskip("ipykernel", reason="needs nbclient and ipykernel, which the extra test installs")
import nbformat  # noqa: E402 - comes with nbclient

NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_runs_and_shows_what_it_says(file: Path, tmp_path: Path) -> None:
    notebook = nbformat.read(file, as_version=4)
    assert all(not cell["outputs"] for cell in notebook.cells if cell.cell_type == "code")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what starts the kernel, not of ours
        nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell["outputs"]]
    assert [output for output in shown if output.output_type == "error" or output.get("name") == "stderr"] == []
    pages = [output.data["text/html"] for output in shown if "data" in output and "text/html" in output.data]
    assert any("<img" in page for page in pages), "no result was shown with its figure"
