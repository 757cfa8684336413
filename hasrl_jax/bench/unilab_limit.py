"""Bare `mj_step` of a model, run by `bench compare --unilab` under the Python of that project, as a file.

`python unilab_limit.py MODEL TIMESTEP_S STEPS SECONDS` prints environment steps and the seconds that they took. The
controls are the first keyframe's with noise, as of a policy that has learnt nothing; robots that fell begin again.
"""

import sys
import time

import mujoco
import numpy as np

ACTION_SCALE = 0.25  # rad by which a unit of its actions moves a target. Source: `action_scale` of the G1 flat walk
MIN_HEIGHT_M = 0.55  # of the pelvis. Source: `min_base_height` there
CHUNK = 50  # environment steps between two looks at the clock


def main() -> None:
    path, timestep_s, steps, seconds = sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
    model = mujoco.MjModel.from_xml_path(path)
    model.opt.timestep = timestep_s
    data, rng = mujoco.MjData(model), np.random.default_rng(0)

    def play(env_steps: int) -> None:
        for noise in ACTION_SCALE * rng.standard_normal((env_steps, model.nu)):
            if data.time == 0 or data.qpos[2] < MIN_HEIGHT_M:
                mujoco.mj_resetDataKeyframe(model, data, 0)
            data.ctrl[:] = model.key_ctrl[0] + noise
            mujoco.mj_step(model, data, steps)

    play(CHUNK)
    done, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        play(CHUNK)
        done += CHUNK
    print(done, time.perf_counter() - started)


if __name__ == "__main__":
    main()
