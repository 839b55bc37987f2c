"""`python -m src.run`: composes conf/ and runs it."""

from qnerf.cli.main import run

if __name__ == "__main__":
    run()
