"""A user's mistake as one line."""

from qnerf.records.printable import printable


def one_line(error: Exception) -> str:
    if type(error).__name__ == "MissingMandatoryValue":  # OmegaConf's, which commands without Hydra never import
        return f"{getattr(error, 'full_key', '?')} must be given"
    return printable(" ".join(str(error).split("\n    full_key")[0].split()))
