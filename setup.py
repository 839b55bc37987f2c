"""The packages of the distribution; everything else is in pyproject.toml.

A wheel holds conf/, sweeps/ and analysis/ inside the package qnerf, where `qnerf.config.folders` finds them.
"""

from setuptools import find_packages, setup

analysis = ["analysis", *(f"analysis.{name}" for name in find_packages("analysis"))]
data = {"qnerf.conf": "conf", "qnerf.sweeps": "sweeps"}
setup(
    packages=[*find_packages("src"), *data, *(f"qnerf.{name}" for name in analysis)],
    package_dir={"": "src", **data, "qnerf.analysis": "analysis"},
    package_data={
        "qnerf": ["py.typed", "scenes/*.npz"],
        "qnerf.conf": ["*.yaml", "*/*.yaml", "*/*/*.yaml"],
        "qnerf.sweeps": ["*.yaml"],
        "qnerf.analysis": [
            *(f"report/*.{kind}" for kind in ("css", "html", "js")),
            "serve/*.js",
            "notebooks/*.ipynb",
        ],
    },
)
