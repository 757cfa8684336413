"""Configurations of version 0.1 are still read."""

from hasrl_jax.config.compat import upgraded
from hasrl_jax.config.convert import from_dict


def test_settings_of_other_tasks_are_left_out():
    config = from_dict(upgraded({"task": "cartpole", "seed": 3, "cassie": {"reward": {"scale": 2.0}}}))
    assert (config.task, config.seed, config.settings) == ("cartpole", 3, None)
    assert from_dict(upgraded({"cassie": {"reward": {"scale": 3.0}}})).settings.reward.scale == 3.0


def test_a_stage_was_a_text():
    text = "2e6 cassie.command.forward_m_s=[-0.3,1.0] cassie.randomize.enabled=true ppo.clip=0.1"
    (stage,) = from_dict(upgraded({"stages": [text]})).stages
    assert stage.at_env_steps == 2_000_000 and not stage.wait_for
    assert stage.set == {
        "cassie.command.forward_m_s": [-0.3, 1.0],
        "cassie.randomize.enabled": True,
        "ppo.clip": 0.1,
    }
    today = [{"at_env_steps": 5, "set": {"ppo.clip": 0.1}}]
    assert upgraded({"stages": today}) == {"stages": today}
