"""The reward terms that compare with a reference, by hand, and the tasks that are made of them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.envs.cassie import gaits, rewards, tracking
from hasrl_jax.envs.cassie.settings import TermConfig, TrackingConfig
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Reading

AT_REST = {"randomize": {"enabled": False}}


def _seen(**changes: object) -> tracking.Seen:
    """A robot that does everything as the reference does, and stands on both feet."""
    reference = {
        "motor_positions": np.linspace(-1, 1, 10)[None],
        "springs": np.array([[0.1, -0.1]]),
        "pelvis_position": np.array([[0.01, -0.02, 0.9]]),
        "pelvis_rotation": np.array([[0.0, 0.1, 0.0]]),
    }
    seen = tracking.Seen(
        reference=reference,
        motors=reference["motor_positions"],
        motor_speeds=np.zeros((1, 10)),
        springs=reference["springs"],
        position=reference["pelvis_position"],
        orientation=np.array([[np.sqrt(0.99), 0.0, 0.1, 0.0]]),
        velocity=np.array([[1.0, 0.0, 0.3]]),
        command=np.array([[1.0, 0.0, 0.2]]),
        angular_velocity=np.array([[0.0, 0.0, 0.2]]),
        acceleration=np.zeros((1, 3)),
        torque_share=np.zeros((1, 10)),
        foot_force=np.array([[160.0, 160.0]]),
        force_clock=np.zeros((1, 2)),
        action_change=np.zeros((1, 10)),
        standing=np.array([True]),
    )
    return seen._replace(**changes)


def test_who_does_exactly_as_the_reference_has_no_error() -> None:
    for name, error in tracking.errors(_seen(), np).items():
        np.testing.assert_allclose(error, 0.0, atol=1e-12, err_msg=name)
    assert set(tracking.errors(_seen(), np)) == set(tracking.TERMS)


@pytest.mark.parametrize(
    ("term", "changes", "expected"),
    [
        # Off by 0.1, 0.2, ... 1 rad; of a leg 0.15 roll^2 + 0.15 yaw^2 + 0.1 pitch^2 + 0.05 knee^2 + 0.05 foot^2.
        ("joints", {"motors": np.linspace(-1, 1, 10)[None] + 0.1 * np.arange(1, 11)}, 0.037 + 0.282),
        ("springs", {"springs": np.array([[0.13, -0.14]])}, 0.0009 + 0.0016),
        ("center_of_mass", {"position": np.array([[0.31, 0.38, 0.7]])}, 0.09 + 0.16 + 0.04),
        ("path", {"position": np.array([[0.31, 0.38, 0.7]])}, 0.09 + 0.16),
        ("height", {"position": np.array([[0.31, 0.38, 0.7]])}, 0.2),
        # Upright, while the reference leans by 2 asin(0.1): the squared sine of half the angle.
        ("attitude", {"orientation": np.array([[-1.0, 0.0, 0.0, 0.0]])}, 0.01),
        ("forward_speed", {"velocity": np.array([[0.6, 0.3, 5.0]])}, 0.4),
        ("lateral_speed", {"velocity": np.array([[0.6, -0.3, 5.0]])}, 0.3),
        ("turning", {"angular_velocity": np.array([[0.3, -0.4, 0.7]])}, 0.09 + 0.16 + 0.25),
        ("torque", {"torque_share": np.array([[1.0, -0.5] + [0.0] * 8])}, 1.25 / 10),
        ("swing_force", {"force_clock": np.array([[-1.0, 1.0]]), "foot_force": np.array([[70.0, 300.0]])}, 0.2),
        ("swing_force", {"force_clock": np.array([[1.0, -0.5]]), "foot_force": np.array([[0.0, 900.0]])}, 0.5),
        ("acceleration", {"acceleration": np.array([[0.0, 9.81, 19.62]])}, 5.0),
        ("action_change", {"action_change": np.array([[0.5, -0.7] + [0.0] * 8])}, 0.12),
        ("still", {"motor_speeds": np.array([[3.0, -1.0] + [0.0] * 8])}, 1.0),
    ],
)
def test_an_error_by_hand(term: str, changes: dict, expected: float) -> None:
    for xp in (np, jnp):
        np.testing.assert_allclose(tracking.errors(_seen(**changes), xp)[term], [expected], rtol=1e-4)


def test_a_term_is_its_weight_at_no_error_and_falls_with_its_sharpness() -> None:
    config = TrackingConfig(scale=2.0, joints=TermConfig(0.5, 30.0), height=TermConfig(0.25, 10.0))
    found = dict.fromkeys(tracking.TERMS, np.zeros(1)) | {"joints": np.array([0.01]), "height": np.array([0.1])}
    terms = dict(zip(tracking.TERMS, tracking.weighted_terms(found, config, np)[0], strict=True))
    assert terms["joints"] == pytest.approx(2 * 0.5 * 0.7408182)
    assert terms["height"] == pytest.approx(2 * 0.25 * 0.3678794)
    assert sum(terms.values()) == pytest.approx(terms["joints"] + terms["height"])
    assert tracking.wanted(config)
    assert not tracking.wanted(TrackingConfig())


def test_nobody_is_rewarded_for_standing_still_while_walking() -> None:
    config = TrackingConfig(still=TermConfig(1.0, 50.0))
    for standing, expected in ((True, 1.0), (False, 0.0)):
        found = tracking.errors(_seen(standing=np.array([standing])), np)
        assert tracking.weighted_terms(found, config, np).sum() == pytest.approx(expected)


def test_the_weights_of_the_two_published_rewards_sum_to_one() -> None:
    for name in ("cassie_imitate", "cassie_gaits"):
        reward = shipped(name).settings.reference.reward
        weights = {term: getattr(reward, term).weight for term in tracking.TERMS}
        total = sum(weights.values()) - weights["still"]
        # Foot height, 3 of 78.5, has no term here.
        expected = 1.0 if name == "cassie_imitate" else 75.5 / 78.5
        assert reward.scale * total == pytest.approx(expected)
        assert not any(getattr(shipped(name).settings.reward, term) for term in rewards.TERMS)


def _reading(task, state: np.ndarray) -> Reading:
    sizes = task.model.nsensordata, 9 if len(task.commands) == 4 else 5
    return Reading(state[None, :35], state[None, 35:], *(np.zeros((1, size)) for size in sizes))


@pytest.mark.parametrize("name", ["cassie_imitate", "cassie_gaits"])
def test_a_robot_in_the_recorded_state_earns_nearly_all_and_one_elsewhere_less(name: str) -> None:
    """The step that ends in the state after the one in which the episode began, but for what sensors would say."""
    library = gaits.load(gaits.USUAL)
    forward, count = 3, library.states.shape[3]  # 1 m/s
    middle, height = len(library.lateral_m_s) // 2, int(np.abs(library.height_m - 0.9).argmin())
    command = {"forward_m_s": [1.0, 1.0], "lateral_m_s": [0, 0], "stand_probability": 0.0, "start_heading_rad": 0.0}
    more = {"yaw_rate_rad_s": [0, 0], "height_m": [0.9, 0.9], "alone_probability": 0.0}
    changes = {"command": command | more, "reference": {"start_share": 1.0}} | AT_REST
    task = make_task(from_dict({"cassie": changes}, shipped(name)))
    uniforms = np.full((1, task.reset_uniforms), 0.5)
    fresh = task.reset(uniforms, np)
    begun = round(float(fresh.state.phase[0]) * count)
    after = library.states[forward, middle, height, begun + 1].copy()
    after[0] += 0.025  # the path has moved on
    sums = []
    for state in (after, library.states[forward, middle, height, (begun + 12) % count]):
        done = task.step(
            fresh.state, np.zeros((1, 10)), _reading(task, state), np.full((1, task.step_uniforms), 0.5), np
        )
        terms = dict(zip(task.reward_terms, done.reward_terms[0], strict=True))
        np.testing.assert_allclose(sum(terms.values()), done.reward[0])
        sums.append(terms["reference_joints"] + terms["reference_attitude"])
    reward = shipped(name).settings.reference.reward
    most = reward.scale * (reward.joints.weight + reward.attitude.weight)
    assert sums[0] > 0.95 * most
    assert sums[1] < 0.7 * most


def test_an_episode_ends_where_the_reference_is_lost() -> None:
    ended = {}
    for least in (0.0, 0.3):
        changes = {
            "reference": {"min_reward": least, "start_share": 0.0},
            "termination": {"min_height_m": 0.0},
        } | AT_REST
        task = make_task(from_dict({"cassie": changes}, shipped("cassie_imitate")))
        fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
        lost = np.concatenate([fresh.qpos[0], np.zeros(32)])
        lost[0], lost[7:] = 30.0, lost[7:] + 1.0
        done = task.step(
            fresh.state, np.zeros((1, 10)), _reading(task, lost), np.full((1, task.step_uniforms), 0.5), np
        )
        assert done.reward[0] < 0.3
        ended[least] = bool(done.terminated[0])
    assert ended == {0.0: False, 0.3: True}


@pytest.mark.parametrize("name", ["cassie_imitate", "cassie_gaits"])
def test_numpy_and_jax_judge_alike(name: str) -> None:
    task = make_task(shipped(name))
    envs, rng = CpuEnvs(task, 4, 1000), np.random.default_rng(0)
    state = envs.reset(rng)
    action = rng.uniform(-0.2, 0.2, (4, 10))
    _, reading, _ = envs._simulate(state, envs._control(state, action))
    uniforms = rng.random((4, task.step_uniforms))
    ours = task.step(state.task, action, reading, uniforms, np)
    theirs = jax.jit(partial(task.step, xp=jnp))(state.task, action, reading, uniforms)
    np.testing.assert_allclose(theirs.reward_terms, ours.reward_terms, atol=2e-4)
    np.testing.assert_allclose(theirs.observation, ours.observation, atol=2e-3)
    np.testing.assert_array_equal(theirs.terminated, ours.terminated)
    assert task.reward_terms == (*rewards.TERMS, *(f"reference_{term}" for term in tracking.TERMS))


@pytest.mark.parametrize("name", ["cassie_imitate", "cassie_gaits"])
def test_the_mirror_image_of_a_robot_earns_the_same(name: str) -> None:
    task = make_task(from_dict({"cassie": AT_REST}, shipped(name)))
    mirror = task.mirror
    assert mirror is not None
    rng = np.random.default_rng(3)
    fresh = task.reset(rng.random((1, task.reset_uniforms)), np)
    state = fresh.state._replace(
        target_heading=np.zeros(1), command=np.array([[0.7, 0.2, 0.3, 0.87][: fresh.state.command.shape[1]]])
    )
    image = state._replace(
        phase=np.mod(state.phase + 0.5, 1.0), command=state.command * [1, -1, -1, 1][: state.command.shape[1]]
    )
    library = gaits.load(gaits.USUAL)
    robot = library.states[2, -1, 0, 7] + rng.normal(scale=0.02, size=67)
    action = rng.uniform(-0.2, 0.2, (1, 10))
    uniforms = np.full((1, task.step_uniforms), 0.5)
    ours = task.step(state, action, _reading(task, robot), uniforms, np)
    theirs = task.step(image, mirror.action(action), _reading(task, gaits.mirrored(robot, gaits.STATE)), uniforms, np)
    np.testing.assert_allclose(theirs.reward_terms, ours.reward_terms, atol=1e-5)
