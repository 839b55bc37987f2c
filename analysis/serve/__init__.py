"""The report as a live page: `qnerf serve runs`."""
