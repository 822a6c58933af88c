# SPDX-License-Identifier: Apache-2.0
"""
Register the reinforcement learning environments `NeedleInsertion-v0`, `NeedleSteering-v0`.

Gymnasium finds them by ``needle_study.gym:NeedleSteering-v0`` (extra ``gym``).
"""

import gymnasium

gymnasium.register(
    'NeedleInsertion-v0',
    'needle_study.gym.insertion:InsertionEnv',
    vector_entry_point='needle_study.gym.insertion:InsertionVectorEnv',
    max_episode_steps=500,
)
gymnasium.register(
    'NeedleSteering-v0',
    'needle_study.gym.steering:SteeringEnv',
    vector_entry_point='needle_study.gym.steering:SteeringVectorEnv',
)
