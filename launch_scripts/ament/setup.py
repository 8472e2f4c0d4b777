"""The package as ``colcon build`` installs it: the library, an executable per node, launch files.

What is not the package's own stands here as links, because ``colcon build --symlink-install`` takes
every name below its own build folder: one with ``..`` would lead out of that.
"""

import re
from pathlib import Path

from setuptools import find_packages, setup

NAME = "slamfusion"
NODES = ("tinyslam", "gmapping", "graph", "fusion", "player")
VERSION = re.findall('__version__ = "(.*)"', Path(NAME, "version.py").read_text())[0]
# With --symlink-install this runs without them, and the library finds them beside the checkout.
KERNELS = [f"{NAME}.kernels"] if Path("kernels").is_dir() else []

setup(
    name=NAME,
    version=VERSION,
    description="Run several 2D SLAMs side by side, align their maps, and let them vote",
    author="The SLAMfusion developers",
    maintainer="The SLAMfusion developers",
    maintainer_email="slamfusion@example.org",
    license="MIT",
    packages=[*find_packages(include=[NAME, f"{NAME}.*"]), *KERNELS],
    package_dir=dict.fromkeys(KERNELS, "kernels"),
    package_data={
        NAME: ["py.typed", "__init__.pyi"],
        f"{NAME}.jobs": ["schema.json"],
        f"{NAME}.page": ["static/*"],
        f"{NAME}.report": ["templates/*"],
        f"{NAME}.viewer": ["static/*"],
        f"{NAME}.kernels": ["*.cl", "*.h"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(map(str, Path("launch").iterdir()))),
        (f"share/{NAME}/config", sorted(map(str, Path("config").iterdir()))),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "slamfusion = slamfusion.cli.main:main",
            *(f"{name}_node = slamfusion.cli.main:node" for name in NODES),
        ]
    },
)
