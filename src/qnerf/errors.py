"""A user's mistake as one line."""


def one_line(error: Exception) -> str:
    if type(error).__name__ == "MissingMandatoryValue":  # OmegaConf's, which commands without Hydra never import
        return f"{getattr(error, 'full_key', '?')} must be given"
    return " ".join(str(error).split("\n    full_key")[0].split())
