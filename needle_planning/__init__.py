# SPDX-License-Identifier: Apache-2.0
"""Plans of an insertion in a segmented image, without ROS."""

from typing import TYPE_CHECKING

from needle_ros.lazy import lazy_names

if TYPE_CHECKING:
    from needle_controller.steering.insertion_plan import Plan as Plan
    from needle_controller.steering.insertion_plan import read_plan as read_plan
    from needle_controller.steering.insertion_plan import write_plan as write_plan
    from needle_planning.anatomy import Anatomy as Anatomy
    from needle_planning.anatomy import ROLES as ROLES
    from needle_planning.anatomy import SegmentationError as SegmentationError
    from needle_planning.anatomy import Structure as Structure
    from needle_planning.chance import Chance as Chance
    from needle_planning.chance import chance_of as chance_of
    from needle_planning.chance import read_population as read_population
    from needle_planning.labels import read_anatomy as read_anatomy
    from needle_planning.planner import find_plan as find_plan
    from needle_planning.planner import NoPathError as NoPathError
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
