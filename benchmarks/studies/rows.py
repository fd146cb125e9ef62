"""A study of several rows: their arguments, one thread, and what is kept after each of them."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import ast_sim
from ast_sim.support.disk import write_json, write_text

Results = dict[str, Any]


def study_rows(
    about: str,
    rows: Collection[str],
    arguments: Sequence[str] | None,
    measured: Callable[[str, Path], Results],
    said: Callable[[Results], str],
    kept: tuple[Path, Path],
    page: Callable[[Results], str],
) -> None:
    """Measure the rows that the command line names, or all; everything runs on one thread. Results of other rows stay.

    Args:
        about: the docstring of the study; its first line is the help.
        rows: the names of all rows.
        arguments: of the command line; None: the arguments of the process.
        measured: gives the result of a row; it keeps data and runs in the folder.
        said: what is printed of a result.
        kept: the files of the results (JSON, by row) and of the page.
        page: the page of all results.
    """
    results_file, page_file = kept
    default = Path("build") / results_file.stem
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"of {', '.join(rows)} (default: all)")
    parser.add_argument("--folder", type=Path, default=default, help=f"data and runs (default: {default})")
    options = parser.parse_args(arguments)
    unknown = set(options.rows) - set(rows)
    if unknown:
        parser.error(f"there is no row {', '.join(sorted(unknown))}")
    import torch  # after ast_sim, which says how its threads wait

    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"  # of the generator's and the solver's processes
    ast_sim.keep_memory()
    results = json.loads(results_file.read_text(encoding="utf-8")) if results_file.exists() else {}
    for name in options.rows or rows:
        results[name] = measured(name, options.folder)
        write_json(results_file, results)
        write_text(page_file, page(results) + "\n")
        print(f"{name}: {said(results[name])}", flush=True)
