# SPDX-License-Identifier: Apache-2.0
"""Plan of an insertion: entry point, direction, setpoints and clearance; its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from math import inf
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_controller.steering.planned_path import PlannedPath
from needle_controller.steering.settings import SteeringPrior
from needle_dynamics.arrays import FloatArray, floats
from needle_dynamics.display import Displayed
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros.errors import ParameterError
from needle_ros.files import read_yaml, write_whole
from needle_ros.settings import checked, unknown_name
import numpy as np
import yaml

DIRECTIONS: Final = 16  #: Number of directions of the free space about a path.
MOST_LAYERS: Final = 8  #: Most layers of tissue along a line.
_FORMAT: Final = 1  #: Version of the file.
_FRAME: Final = 'RAS, SI units'  #: Frame and units of the file.
_HEAD: Final = 'plan', 'frame'  #: Keys of a file before the fields of a plan.
_MORE: Final = 'simulation'  #: Key of a file that may follow them.
_SAME: Final = 1e-4  #: Tolerance of the target [m], and of the length of the direction [1].
#: Fields of a plan that are distances.
_DISTANCES: Final = 'radius', 'bow', 'resolution'
#: Constants of `SteeringParameters` with one value for each layer.
_BY_LAYER: Final = 'bevel_load', 'cutting_force', 'coulomb_per_length', 'viscous_per_length'


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan(Displayed):
    """
    Planned insertion; positions are in patient coordinates, RAS [m].

    The guide has the axes `axes`. It is at zero until the needle has pierced the skin, moves to
    the setpoint of a step while the needle rests, and rests while the needle is inserted.
    """

    needle: str  #: name or file of the needle
    radius: float  #: radius of the needle [m]
    entry: FloatArray  #: entry point, shape (3,)
    direction: FloatArray  #: direction of the insertion, unit vector, shape (3,)
    target: FloatArray  #: target of the tip, shape (3,)
    roll: float  #: roll of the needle [rad]
    depths: FloatArray  #: depths of the steps [m], shape (n + 1,)
    guide: FloatArray  #: position of the guide in x and z in each step [m], shape (n, 2)
    path: FloatArray  #: expected position of the tip at each depth [m], shape (n + 1, 3)
    clearances: FloatArray  #: least clearance of the shaft in the step to each depth [m], (n + 1,)
    clearance: float  #: least clearance [m]
    structure: str  #: structure with the least clearance; '' if it is beyond 30 mm
    place: FloatArray  #: point of the shaft with the least clearance, shape (3,)
    bow: float  #: largest deflection of the shaft from the straight line [m]
    resolution: float  #: resolution of the search [m]
    straight_bound: float  #: no straight needle has a larger clearance [m]
    bound: float  #: no needle within the limits of the guide has a larger clearance [m]
    #: Depth at which each layer of tissue begins [m], median stiffness [N/m^2], and standard
    #: deviation of its logarithm, shape (layers, 3); without rows, the tissue of the needle file.
    layers: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    #: Free space around the path: depth of each place, and free distance from the path in 16
    #: directions from x to z [m], shape (places, 17); without rows, it is not known.
    free: FloatArray = field(default_factory=lambda: np.zeros((0, 1 + DIRECTIONS)))

    @property
    def length(self) -> float:
        """Length of the straight line from entry point to target [m]."""
        return float(self.depths[-1])

    @property
    def at_limit(self) -> bool:
        """Whether the clearance is at the limit of the search, 30 mm, and may be larger."""
        return not self.structure

    @property
    def axes(self) -> FloatArray:
        """Axes x, y (direction) and z of the guide in patient coordinates, rows, shape (3, 3)."""
        return guide_axes(self.direction)

    @property
    def tip_path(self) -> PlannedPath:
        """Path of the tip in the frame of the guide, for a steering law."""
        tips = (self.path - self.entry) @ self.axes[[0, 2]].T
        return PlannedPath(depths=self.depths, tips=tips, guide=self.guide)

    def columns(self) -> dict[str, FloatArray]:
        guide = np.vstack([self.guide, self.guide[-1:]])
        return {
            'depth [m]': self.depths,
            'guide_x [m]': guide[:, 0],
            'guide_z [m]': guide[:, 1],
            'tip_r [m]': self.path[:, 0],
            'tip_a [m]': self.path[:, 1],
            'tip_s [m]': self.path[:, 2],
            'clearance [m]': self.clearances,
        }


def guide_axes(direction: FloatArray) -> FloatArray:
    """
    Return the axes x, y, z of the guide in patient coordinates, rows, shape (3, 3).

    y is the direction of the insertion, z points up (S) as far as possible, or to the front (A)
    for an insertion along the body axis.
    """
    y = direction / np.linalg.norm(direction)
    up = np.array([0.0, 0.0, 1.0]) if abs(y[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    z = up - (up @ y) * y
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z])


def write_plan(plan: Plan, path: Path | str, simulation: Mapping[str, Any] | None = None) -> None:
    """
    Write a plan as a YAML file, atomically.

    Parameters
    ----------
    plan : Plan
        Plan.
    path : Path or str
        File; ParameterError if it cannot be written.
    simulation : mapping, optional
        Results of simulated insertions, `Chance.document`.

    """
    more = {_MORE: dict(simulation)} if simulation else {}
    values = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in asdict(plan).items()
    }
    text = yaml.safe_dump(
        {'plan': _FORMAT, 'frame': _FRAME, **values, **more},
        default_flow_style=None,
        sort_keys=False,
        width=100,
    )
    write_whole(path, text.encode())


def read_plan(path: Path | str) -> Plan:
    """
    Read a plan from a file of `write_plan`.

    Parameters
    ----------
    path : Path or str
        File.

    Returns
    -------
    Plan
        The same plan; NeedleError with file and key if it is not a plan of `write_plan`.

    """
    document = read_yaml(path)
    if not isinstance(document, dict) or document.get('plan') != _FORMAT:
        raise ParameterError(f'{path} is not a plan of format {_FORMAT}')
    names = [item.name for item in fields(Plan)]
    known = (*_HEAD, *names, _MORE)
    if unknown := [key for key in document if key not in known]:
        raise ParameterError(f'{path}: {unknown_name(str(unknown[0]), known)}')
    if missing := [name for name in (*_HEAD, *names) if name not in document]:
        raise ParameterError(f'{path}: {missing[0]} is missing')
    if document['frame'] != _FRAME:
        raise ParameterError(f'{path}: frame must be {_FRAME}, got {document["frame"]!r}')
    guide = document.get('guide')
    if not (isinstance(guide, list) and guide):
        raise ParameterError(f'{path}: guide must be a list of setpoints x, z, got {guide!r}')
    steps = len(guide)
    shapes = {
        'entry': (3,), 'direction': (3,), 'target': (3,), 'place': (3,), 'depths': (steps + 1,),
        'guide': (steps, 2), 'path': (steps + 1, 3), 'clearances': (steps + 1,),
    }  # fmt: skip
    values: dict[str, Any] = {
        name: _value(f'{path}: {name}', name, document[name], shapes) for name in names
    }
    plan = Plan(**values)
    if plan.depths[0] != 0.0 or (np.diff(plan.depths) <= 0.0).any():
        raise ParameterError(f'{path}: depths must increase from 0 m')
    if abs(norm := float(np.linalg.norm(plan.direction)) - 1.0) > _SAME:
        raise ParameterError(f'{path}: direction must have the length 1, got {norm + 1.0:.6g}')
    off = float(np.linalg.norm(plan.entry + plan.length * plan.direction - plan.target))
    if off > _SAME:
        raise ParameterError(
            f'{path}: target must be entry + length * direction, with the last of depths '
            f'{plan.length:g} m as length; it is {1e3 * off:.4g} mm from there'
        )
    return plan


def _check_numbers(name: str, value: object) -> None:
    """Raise `ParameterError` if a list has anything but numbers, such as true or text."""
    for one in value if isinstance(value, list) else ():
        if isinstance(one, list):
            _check_numbers(name, one)
        elif isinstance(one, bool) or not isinstance(one, (int, float)):
            raise ParameterError(f'{name} must be numbers, got {one!r}')


def _value(name: str, item: str, value: object, shapes: Mapping[str, tuple[int, ...]]) -> object:
    _check_numbers(name, value)
    if item == 'layers':
        return _layers(name, value)
    if item == 'free':
        return _free(name, value)
    if item in shapes:
        return floats(name, value, shapes[item])
    if item in ('needle', 'structure'):
        if not isinstance(value, str):
            raise ParameterError(f'{name} must be text, got {value!r}')
    else:
        checked(name, value, 'm', low=0.0 if item in _DISTANCES else -inf)
    return value


def _layers(name: str, value: object) -> FloatArray:
    if not value:
        return np.zeros((0, 3))
    found = floats(name, value, (None, 3))
    starts, stiffnesses, spreads = found.T
    if starts[0] != 0.0 or (np.diff(starts) <= 0.0).any():
        raise ParameterError(f'{name} must begin at 0 m and at increasing depths')
    if len(found) > MOST_LAYERS or (stiffnesses <= 0.0).any() or (spreads < 0.0).any():
        raise ParameterError(
            f'{name} must be at most {MOST_LAYERS}, each with a stiffness > 0 N/m^2 and a spread '
            '>= 0'
        )
    return found


def _free(name: str, value: object) -> FloatArray:
    if not value:
        return np.zeros((0, 1 + DIRECTIONS))
    found = floats(name, value, (None, 1 + DIRECTIONS))
    if (np.diff(found[:, 0]) <= 0.0).any() or (found < 0.0).any():
        raise ParameterError(f'{name} must be at increasing depths, with distances >= 0 m')
    return found


class LayeredTissue(NamedTuple):
    """Needle in the layers of a plan, and the prior uncertainty of these layers."""

    needle: NeedleParameters
    steering: SteeringParameters
    prior: SteeringPrior


def in_layers(
    layers: FloatArray,
    needle: NeedleParameters,
    steering: SteeringParameters,
    prior: SteeringPrior | None = None,
) -> LayeredTissue:
    """Return a needle of a needle file, and a prior, in layers of a plan."""
    prior = prior or SteeringPrior()
    if not len(layers):
        return LayeredTissue(needle, steering, prior)
    starts, stiffnesses, spreads = layers.T
    own = np.searchsorted(needle.tissue.starts, starts, side='right') - 1
    values = {name: getattr(steering, name) for name in _BY_LAYER}
    found: dict[str, Any] = {
        name: tuple(several[k] for k in own)
        for name, several in values.items()
        if len(several) > 1
    }
    (first, *others), (_, *borders) = stiffnesses.tolist(), starts.tolist()
    return LayeredTissue(
        replace(
            needle,
            tissue_stiffness=first,
            layer_depths=tuple(borders),
            layer_stiffnesses=tuple(others),
        ),
        replace(steering, **found),
        replace(prior, layer_spread=tuple(spreads.tolist())) if spreads.any() else prior,
    )
