# SPDX-License-Identifier: Apache-2.0
"""Package needle_insertion for pip and ament; package.xml holds name and version."""

from pathlib import Path
import runpy
import xml.etree.ElementTree as ET

from setuptools import Distribution, find_packages, setup

# colcon --symlink-install runs this file through a link, in a folder without README.md.
ROOT = Path(__file__).resolve().parent
MANIFEST = ET.parse(ROOT / 'package.xml').getroot()  # noqa: S314
NAME = MANIFEST.findtext('name')
NODES = runpy.run_path(str(ROOT / 'needle_insertion/nodes.py'))['NODES']
#: OpenIGTLink library of the node `slicer`.
SLICER = ['pyigtl>=0.3.4']
#: Output format of `needle study`, its `--scheduler`, and learning environments.
STUDY = ['pyarrow>=15']
DASK = [*STUDY, 'distributed>=2024.5']
GYM = ['gymnasium>=1.1']
#: Readers of segmentations.
PLAN = ['nibabel>=5.2', 'pynrrd>=1.0', 'trimesh>=4.0']
#: Results as a DataFrame, `to_dataframe`.
PANDAS = ['pandas>=2.0']
TEST = [
    'hypothesis>=6.100',
    'lxml>=5.0',
    'mpmath>=1.3',
    'psutil>=5.8',
    'pytest>=8.0',
    'pytest-timeout>=2.3',
    'sympy>=1.12',
    'xacro>=2.1',
    *SLICER,
    *DASK,
    *GYM,
    *PANDAS,
    *PLAN,
]


def files(folder: str, pattern: str) -> list[str]:
    """List files below a folder as relative paths for setuptools."""
    return [str(path.relative_to(ROOT)) for path in sorted((ROOT / folder).glob(pattern))]


#: Functions compiled for a processor level by `make wheel`.
COMPILED = files('needle_dynamics', 'compiled/__pycache__/*.v3.nbc')


class Compiled(Distribution):
    """Distribution for one Python version and platform if it contains machine code."""

    def has_ext_modules(self) -> bool:
        return bool(COMPILED)


setup(
    name=NAME,
    distclass=Compiled,
    version=MANIFEST.findtext('version'),
    description=MANIFEST.findtext('description'),
    license=MANIFEST.findtext('license'),
    author=MANIFEST.findtext('author'),
    author_email=MANIFEST.find('author').get('email'),
    maintainer=MANIFEST.findtext('maintainer'),
    maintainer_email=MANIFEST.find('maintainer').get('email'),
    long_description=(ROOT / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    python_requires='>=3.10',
    classifiers=[
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        *(f'Programming Language :: Python :: 3.{minor}' for minor in range(10, 14)),
        'Topic :: Scientific/Engineering',
        'Typing :: Typed',
    ],
    packages=find_packages(include=['needle_*', 'reproduction*']),
    package_data={
        '': ['py.typed'],
        'needle_ros': ['*.xml'],
        'needle_dynamics.compiled': ['__pycache__/*.v3.nbc'],
        'needle_insertion.report': ['templates/*'],
        'reproduction.claims': ['*.yaml'],
        'needle_insertion.watch': ['page/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/needle_insertion']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', files('config', '*.*')),
        (f'share/{NAME}/config/security', files('config/security', '*.xml')),
        (f'share/{NAME}/description', files('description', '*.*')),
        (f'share/{NAME}/description/meshes', files('description/meshes', '*.stl')),
        (f'share/{NAME}/launch', files('launch', '*.launch.py')),
        # Folder of ros2 run; pip installs the same nodes on PATH as needle-<name>.
        (f'lib/{NAME}', [f'scripts/{node}' for node in NODES]),
    ],
    install_requires=[
        'aiohttp>=3.9',
        'argcomplete>=2.0',
        'jinja2>=3.1',
        'lz4>=4.0',
        'markupsafe>=2.1',
        'matplotlib>=3.6',
        'mcap>=1.5',
        'numba>=0.58',
        'numpy>=1.24',
        'PyYAML>=6.0',
        'rosbags>=0.11',
        'scipy>=1.11',
        'tqdm>=4.64',
        'zstandard>=0.22',
    ],
    extras_require={
        # ROS 2 Jazzy from wheels; leave out on a machine that has ROS.
        'ros': [
            'ros-jazzy-common-interfaces>=5.3',
            'ros-jazzy-domain-coordinator>=0.12',
            'ros-jazzy-lifecycle-msgs>=2.0',
            'ros-jazzy-rclpy>=7.1.6',
            'ros-jazzy-rmw-fastrtps-cpp>=8.4',
        ],
        # ROS 2 Kilted in place of Jazzy.
        'kilted': [
            'ros-domain-coordinator>=0.12',
            'ros-kilted-common-interfaces>=5.5',
            'ros-kilted-lifecycle-msgs>=2.3',
            'ros-kilted-rclpy>=9.1',
            'ros-kilted-rmw-fastrtps-cpp>=9.3',
        ],
        'slicer': SLICER,
        # Name of the extra that colcon test expects for pytest.
        'test': TEST,
        'dev': [
            *TEST,
            'colcon-common-extensions>=0.3',
            'mypy>=1.14',
            'pytest-xdist>=3.5',
            'ruff>=0.9',
        ],
        # `make docs`; locked separately in requirements-docs.lock.
        'docs': [
            'furo>=2024.8',
            'myst-parser>=4.0',
            'numpydoc>=1.8',
            'sphinx>=8.1,<9',
            'sphinx-gallery>=0.18',
        ],
        'study': STUDY,
        'dask': DASK,
        'gym': GYM,
        'pandas': PANDAS,
        'plan': PLAN,
        # Reference tools of `needle bench`.
        'bench': [
            'diffrax>=0.6',
            'jax>=0.5',
            'mcap-ros2-support>=0.5.6',
            'mujoco>=3.2',
            'ompl>=2.0.1',
            'psutil>=5.8',
            'pyelastica>=0.3.3',
            *SLICER,
            *DASK,
            *GYM,
        ],
        # Learned policies of `needle bench learning`.
        'learning': ['stable-baselines3>=2.9', *GYM],
    },
    entry_points={
        'console_scripts': [
            'needle = needle_insertion.cli:main',
            *(f'needle-{node} = needle_insertion.nodes:main' for node in NODES),
        ]
    },
    zip_safe=False,
)
