# SPDX-License-Identifier: Apache-2.0
"""Write a synthetic segmentation: a liver with vessels and a target, behind ribs and skin."""

from pathlib import Path

from needle_planning import read_anatomy
import nrrd
import numpy as np

SHAPE = (96, 96, 64)
SPACING = 2.0  # [mm]
#: Center of the first voxel, LPS [mm]: the right side of the body is at negative x.
ORIGIN = (-160.0, -95.0, -63.0)

x, y, z = (
    start + SPACING * steps for start, steps in zip(ORIGIN, np.ogrid[:96, :96, :64], strict=True)
)
# 1 at the skin.
body = (x / 150) ** 2 + (y / 90) ** 2 + 0 * z
# Rings around the body, 24 mm apart, 10 mm thick, open to the front.
from_wall = np.hypot((np.sqrt(body) - 0.88) * 120, (z + 0.25 * y + 12) % 24 - 12)


def tube(start: tuple[float, ...], end: tuple[float, ...], radius: float) -> np.ndarray:
    """Return the voxels of a straight vessel with round ends."""
    along = np.subtract(end, start)
    length = float(along @ along)
    share = sum(a * (p - s) for a, p, s in zip(along, (x, y, z), start, strict=True)) / length
    share = np.clip(share, 0, 1)
    apart = (p - s - share * a for a, p, s in zip(along, (x, y, z), start, strict=True))
    return np.asarray(sum(one**2 for one in apart) < radius**2)


#: Voxels by layer and name. Segments of one layer do not overlap: the last is kept.
LAYERS = [
    {'body': body < 1},
    {
        'liver': ((x + 70) / 52) ** 2 + ((y + 5) / 65) ** 2 + (z / 52) ** 2 < 1,
        'portal vein': tube((-30, 10, -40), (-105, -5, 12), 6),
        'hepatic vein': tube((-35, -30, 50), (-80, 20, -6), 5),
        'tumor': (x + 62) ** 2 + (y + 12) ** 2 + (z - 10) ** 2 < 9**2,
        'ribs': (from_wall < 5) & (y > -60) & (body < 1),
        'entry': (body > 0.94) & (body < 1) & (x < -100) & (np.abs(z) < 45) & (np.abs(y) < 60),
    },
]

values = np.zeros((len(LAYERS), *SHAPE), np.uint8)
header = {
    'space': 'left-posterior-superior',
    'space directions': [[np.nan] * 3, *(SPACING * np.eye(3)).tolist()],
    'space origin': ORIGIN,
    'kinds': ['list', 'domain', 'domain', 'domain'],
    'encoding': 'gzip',
}
number = 0
for layer, segments in enumerate(LAYERS):
    for value, (name, voxels) in enumerate(segments.items(), 1):
        values[layer][np.broadcast_to(voxels, SHAPE)] = value
        fields = {'ID': name, 'Name': name, 'Layer': str(layer), 'LabelValue': str(value)}
        header |= {f'Segment{number}_{key}': text for key, text in fields.items()}
        number += 1
nrrd.write('liver.seg.nrrd', values, header, compression_level=9)

labels = Path(__file__).parent / 'liver/labels.yaml'
(anatomy,) = read_anatomy('liver.seg.nrrd', labels)
for label, structure in anatomy.structures.items():
    volume = np.count_nonzero(anatomy.labels == label) * SPACING**3 / 1000
    print(f'{structure.name}: {structure.role}, {volume:.1f} ml')
