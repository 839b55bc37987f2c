"""Packages of the distribution: src/qnerf, with conf/, sweeps/ and analysis/ inside. The rest is in pyproject.toml."""

from setuptools import find_packages, setup

analysis = ["analysis", *(f"analysis.{name}" for name in find_packages("analysis"))]
setup(
    packages=[*find_packages("src"), "qnerf.conf", "qnerf.sweeps", *(f"qnerf.{name}" for name in analysis)],
    package_dir={"": "src", "qnerf.conf": "conf", "qnerf.sweeps": "sweeps", "qnerf.analysis": "analysis"},
    package_data={
        "qnerf": ["py.typed"],
        "qnerf.conf": ["*.yaml", "*/*.yaml", "*/*/*.yaml"],
        "qnerf.sweeps": ["*.yaml"],
        "qnerf.analysis": ["paper/*.csv", "report/*.css", "report/*.html", "report/*.js", "notebooks/*.ipynb"],
    },
)
