"""`python -m qnerf`: the console command `qnerf`."""

from qnerf.cli.main import main

if __name__ == "__main__":
    main()
