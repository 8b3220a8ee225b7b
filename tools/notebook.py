"""Runs the code of the documentation's notebooks, top to bottom, and stores what each cell prints and draws.

    .venv/bin/python tools/notebook.py docs/notebooks/a-run.ipynb --picture docs/figures/demo.png

--picture: also write the first picture of the first notebook to this file; README shows the demo's.
Cells are plain Python here, without IPython's magics, so no Jupyter has to be installed. They run in the notebook's
folder. A test runs them as well, and compares what they print.

Exit status: 0 stored, 1 a cell has failed, with its traceback; 2 wrong usage.
"""

import argparse
import base64
import contextlib
import io
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import pyplot as plt

DOTS_PER_INCH = 80.0


def run_notebook(notebook: dict[str, Any], folder: Path, name: str) -> None:
    """Run the code cells in `folder`, in one namespace; their outputs and numbers replace those in `notebook`."""
    mpl.use("agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(cells, start=1):
        printed = io.StringIO()
        with contextlib.chdir(folder), contextlib.redirect_stdout(printed):
            exec(compile("".join(cell["source"]), f"{name}, cell {number}", "exec"), names)
        cell["execution_count"] = number
        cell["outputs"] = _outputs(printed.getvalue())
    plt.close("all")


def _outputs(printed: str) -> list[dict[str, Any]]:
    """Make a cell's outputs, as nbformat 4 has them, of what it has printed and of the figures that are open."""
    outputs: list[dict[str, Any]] = []
    if printed:
        outputs.append({"name": "stdout", "output_type": "stream", "text": printed.splitlines(keepends=True)})
    for number in plt.get_fignums():
        picture = io.BytesIO()
        plt.figure(number).savefig(picture, dpi=DOTS_PER_INCH, metadata={"Software": None})
        data = {"image/png": base64.b64encode(picture.getvalue()).decode(), "text/plain": ["<Figure>"]}
        outputs.append({"data": data, "metadata": {}, "output_type": "display_data"})
    plt.close("all")
    return outputs


def printed(notebook: dict[str, Any]) -> list[str]:
    """Return what each code cell has printed."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return ["".join(line for out in cell["outputs"] for line in out.get("text", ())) for cell in cells]


def pictures(notebook: dict[str, Any]) -> list[bytes]:
    """Return the pictures, PNG, in their order."""
    data = [out.get("data", {}) for cell in notebook["cells"] for out in cell.get("outputs", ())]
    return [base64.b64decode(each["image/png"]) for each in data if "image/png" in each]


def main() -> None:
    """Run notebooks where they lie and store them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("notebooks", nargs="+", type=Path, metavar="NOTEBOOK")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="write the first picture to this PNG file, too")
    given = parser.parse_args()
    for path in given.notebooks:
        notebook = json.loads(path.read_text(encoding="utf-8"))
        run_notebook(notebook, path.parent, path.name)
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(f"{path}: {len(printed(notebook))} cells, {len(pictures(notebook))} pictures")
        if given.picture is not None and path == given.notebooks[0]:
            given.picture.write_bytes(pictures(notebook)[0])


if __name__ == "__main__":
    main()
