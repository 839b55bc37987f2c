"""Results of the benchmarks, which several figures draw."""

from pathlib import Path

import pandas as pd

from qnerf.config.folders import BENCHMARKS
from qnerf.records.read import read_table

Results = str | Path | pd.DataFrame | None
"""A benchmark's results, or the file that holds them; None: the file that comes with qnerf."""


def read(benchmark: str, results: Results = None) -> pd.DataFrame:
    """The rows of a benchmark's results. Raises ValueError where the file does not exist or is damaged."""
    if isinstance(results, pd.DataFrame):
        return results
    file = Path(results) if results else BENCHMARKS / f"{benchmark}.parquet"
    if not file.is_file():
        raise ValueError(f"{file}: expected the results of the benchmark {benchmark}; there is no such file")
    return read_table(file).to_pandas()
