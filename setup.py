"""Installs the package as ament_python expects it; what it depends on stands in package.xml and requirements.txt."""

from glob import glob
from os.path import isfile

from setuptools import find_packages, setup

PACKAGE = "stereoreg_ros"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Registers a stereotactic frame to a CT scanner from one slice through its straight rods.",
    maintainer="stereoreg_ros maintainers",
    maintainer_email="maintainers@example.org",
    license="MIT",
    python_requires=">=3.10",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed"]},
    zip_safe=False,
    # No PyPI names here: on a robot these come from the distribution, under other names.
    install_requires=["setuptools"],
    # colcon test runs pytest only where this extra names it.
    extras_require={"test": ["pytest", "hypothesis"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(glob("config/*.*"))),
        (f"share/{PACKAGE}/config/frames", sorted(glob("config/frames/*.yaml"))),
        (f"share/{PACKAGE}/launch", sorted(filter(isfile, glob("launch/*")))),
    ],
    entry_points={
        "console_scripts": [
            "stereoreg = stereoreg_ros.cli:main",
            "register_node = stereoreg_ros.nodes.register.register_node:main",
            "simulate_node = stereoreg_ros.nodes.scanner.simulate_node:main",
            "play_dicom_node = stereoreg_ros.nodes.scanner.play_dicom_node:main",
            "receive_dicom_node = stereoreg_ros.nodes.scanner.receive_dicom_node:main",
            "demo_report = stereoreg_ros.nodes.demo.demo_report:main",
        ],
    },
)
