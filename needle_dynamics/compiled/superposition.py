# SPDX-License-Identifier: Apache-2.0
"""Planar insertion of a needle for many load cases (causes) at once."""

from needle_dynamics.arrays import Matrix, Vector
from needle_dynamics.compiled.beam import begin, cross, element, SpringSupports
from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.cut import SHIFT
import numpy as np


@kernel
def insert_causes(
    ei: float,
    skin: float,
    free: float,
    depths: Vector,
    stiffness: Vector,
    tilts: Vector,
    guides: Matrix,
    loads: Matrix,
    tips: Matrix,
    forces: Matrix,
) -> None:
    """Insert a needle in one plane for m independent causes, with the same k depths for all."""
    # The compliance of the needle and the transfer over an element do not depend on the cause and
    # are computed once. The force on the guide is propagated from node to node: by reciprocity, a
    # load at the end of the needle acts on the guide as the guide acts on that end. ``depths``,
    # shape (k,), begin at 0 [m]: an increase cuts an element, a repeated depth is at rest;
    # ``stiffness``, shape (k,), is that of the tissue along the element that ends at each depth
    # [N/m^2]. By cause: ``tilts``, shape (m,); ``guides`` and ``loads``, shape (k, m), position of
    # the guide [m] and lateral load on the tip [N]. Outputs, shape (k, m): ``tips``, deflection
    # [m], and ``forces`` on the guide [N].
    count = len(tilts)
    s = SpringSupports(
        np.empty(1), np.empty(1), np.empty((1, 3)),
        np.empty((1, 2, 2)), np.empty((1, 2, 2)), np.empty((1, 2, 3)),
    )  # fmt: skip
    begin(s, ei, free, skin, np.zeros(2))
    c00, c01, c11 = s.compliance[0, 0], s.compliance[0, 1], s.compliance[0, 2]
    # Deflection and slope of the unloaded end per position and tilt of the guide.
    w_b, w_tilt = s.response[0, 0, 0], s.response[0, 0, 1]
    t_b, t_tilt = s.response[0, 1, 0], s.response[0, 1, 1]
    # Force on the guide per position and tilt of the guide, and per position of the entry
    # point: without a free length the skin is fixed to the guide and exerts no force on it.
    entry_force = skin * w_b if free > 0.0 else 0.0
    force_b, force_tilt = -entry_force, -entry_force * free
    # By cause: the unloaded end and the force on the guide, both with the guide at zero; the path
    # at this node and at the previous node.
    w, t, force = np.empty(count), np.empty(count), np.empty(count)
    path, previous = np.empty(count), np.zeros(count)
    restarted = np.ones(count, dtype=np.bool_)
    for j in range(count):
        # The load bends the needle before the skin supports it.
        entry = guides[0, j] + free * tilts[j] + free**3 / (3.0 * ei) * loads[0, j]
        path[j], force[j] = entry, entry_force * entry
        w[j], t[j] = (1.0 - w_b) * entry, -t_b * entry
    before = 1.0
    for i in range(len(depths)):
        h = depths[i] - depths[max(i - 1, 0)]
        if h > 0.0:
            k = stiffness[i]
            e = element(ei, k, h)
            c = cross(e, c00, c01, c11)
            c00, c01, c11 = c.c00, c.c01, c.c11
            # Force on the guide per deflection, slope and curvature at the start of the element.
            end_w, end_t = c.t00 * w_b + c.t01 * t_b, c.t10 * w_b + c.t11 * t_b
            force_w = k * (end_t * e.p2 - end_w * e.p1)
            force_t = k * (end_t * e.p3 - end_w * e.p2)
            force_bend = k * (end_w * e.p3 - end_t * e.p4)
            force_b += force_w * w_b + force_t * t_b
            force_tilt += force_w * w_tilt + force_t * t_tilt
            w_b, t_b = end_w, end_t
            w_tilt, t_tilt = c.t00 * w_tilt + c.t01 * t_tilt, c.t10 * w_tilt + c.t11 * t_tilt
            # The path continues as a parabola through the previous node, this node and the tip,
            # or from this node as a straight line to the tip.
            line = 1.0 / h
            curved = 2.0 / (h * (h + before))
            turned = 0.5 * before * curved
            line_gain = 1.0 / (1.0 - line * c.slope[0])
            curved_gain = 1.0 / (1.0 - turned * c.slope[0] - curved * c.bend[0])
            for j in range(count):
                p = path[j]
                if abs(tips[i - 1, j] - p) > SHIFT:
                    # The tip was shifted at rest: the path restarts at it.
                    p, restarted[j] = tips[i - 1, j], True
                end_w, end_t = c.t00 * w[j] + c.t01 * t[j], c.t10 * w[j] + c.t11 * t[j]
                own = w_b * guides[i, j] + w_tilt * tilts[j] + c00 * loads[i, j]
                apart = end_w + own + p * c.value[0] - p
                if restarted[j]:
                    d, b = line * line_gain * apart, 0.0
                else:
                    d = (p - previous[j]) / before
                    apart = curved_gain * (apart + d * (c.slope[0] - h))
                    d, b = d + turned * apart, curved * apart
                force[j] += force_w * (w[j] - p) + force_t * (t[j] - d) + force_bend * b
                w[j] = end_w + p * c.value[0] + d * c.slope[0] + b * c.bend[0]
                t[j] = end_t + p * c.value[1] + d * c.slope[1] + b * c.bend[1]
                previous[j], path[j], restarted[j] = p, p + h * (d + 0.5 * h * b), False
            before = h
        for j in range(count):
            guide, tilt, load = guides[i, j], tilts[j], loads[i, j]
            tips[i, j] = w[j] + w_b * guide + w_tilt * tilt + c00 * load
            forces[i, j] = force[j] + force_b * guide + force_tilt * tilt + w_b * load
