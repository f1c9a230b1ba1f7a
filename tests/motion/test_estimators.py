import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from skimage import data

from scsr_opt.camera.scenes import Affine, Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.errors import InputError
from scsr_opt.motion import (
    ILK,
    TVL1,
    Automatic,
    Dense,
    Estimator,
    Global,
    Motion,
    PhaseCorrelation,
    Still,
    estimate_motion,
)
from scsr_opt.motion.estimators.frames import MotionFrames, motion_frames
from scsr_opt.motion.validation import validate_motion

EVERY = [Still(), Global(), Global(affine=False), Dense(), Automatic(), PhaseCorrelation(), ILK(), TVL1()]
MOVING = EVERY[1:]


def name(estimator: Estimator) -> str:
    return type(estimator).__name__ + ("" if getattr(estimator, "affine", True) else "-translation")


# 0.005 sensor px per frame are a quarter of a sensor pixel at the ends of 101 frames, half an HR pixel at ×2; measured
# are errors below 0.0015 (0.3 % of the speed where that is more).
@pytest.mark.parametrize("speed", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("estimator", [Global(), Global(affine=False), Automatic(), PhaseCorrelation()], ids=name)
def test_a_translation_of_the_whole_scene(estimator, speed, pictures, error):
    assert error(estimator(pictures(f"translate{speed}")).velocity, f"translate{speed}").max() < 0.005


def test_phase_correlation_has_no_speed_limit_that_matters(pictures, error):
    assert error(PhaseCorrelation()(pictures("translate2.0")).velocity, "translate2.0").max() < 0.005


def test_phase_correlation_says_how_well_the_pairs_agree(pictures):
    assert PhaseCorrelation()(pictures("translate0.3")).confidence.min() > 0.9
    noise = np.random.default_rng(0).random((101, 40, 40)) < 0.3
    assert PhaseCorrelation()(motion_frames(noise, key=50)).confidence.max() < 0.5


def test_phase_correlation_holds_in_dim_light_and_starts_the_affine_fit_there():
    picture = gaussian_filter(np.random.default_rng(0).random((200, 200)), 2)
    picture = (picture - picture.min()) / np.ptp(picture)
    scene = Translation(picture, (0.36, -0.48))
    spikes = simulate(scene, scale=2, sensor=Sensor(white_rate=0.12, photons=50.0)).spikes
    for estimator, bound in ((PhaseCorrelation(), 0.01), (Global(), 0.05)):
        velocity = estimate_motion(spikes, key=50, white_rate=0.12, estimator=estimator).velocity
        assert np.abs(velocity - np.array([0.18, -0.24])[:, None, None]).max() < bound


@pytest.mark.parametrize(("sensor", "bound"), [(Sensor(photons=1000.0), 1e-3), (Sensor(0.1, 25.0), 0.02)])
@pytest.mark.parametrize("key", [0, 100])
def test_a_key_frame_at_an_end(key, sensor, bound):
    """Before a pixel's first spike and after its last one its light is that of other times, and stands still. Where
    these frames took part because the key frame is among them, the velocity was wrong by 0.006 and 0.07 to 0.11."""
    scene = Translation(data.camera()[50:250, 50:250] / 255, (0.1, 0.22), key=key)
    spikes = simulate(scene, scale=2, sensor=sensor, seed=0).spikes
    found = estimate_motion(spikes, key=key, white_rate=sensor.white_rate, estimator=Global()).velocity
    assert np.abs(found - np.array([0.05, 0.11])[:, None, None]).max() < bound


def test_one_motion_is_found_in_dim_light():
    """Where a pixel fires once in several pixels of motion, it cannot contradict that motion."""
    scene = Translation(data.camera()[88:248, 176:336] / 255, (0.14, -0.24), key=50)
    spikes = simulate(scene, scale=2, sensor=Sensor(white_rate=0.1, photons=25.0)).spikes
    motion = estimate_motion(spikes, key=50, white_rate=0.1)
    assert motion.layers is None
    assert np.ptp(motion.velocity, axis=(1, 2)).max() == 0
    assert np.abs(motion.velocity[:, 0, 0] - np.array([0.07, -0.12])).max() < 0.005


# Thirty sensor pixels over the recording: a comparison of its first with its last picture breaks there. Two of three
# pixels within 0.02 px per frame (2 px over the recording) or better; flat parts of the picture know less.
@pytest.mark.parametrize("estimator", [Dense(), ILK(), TVL1()], ids=name)
@pytest.mark.parametrize("scene", ["translate0.3", "affine", "object", "disc"])
def test_dense_estimates_hold_up_to_thirty_pixels_of_displacement(estimator, scene, pictures, error):
    motion = estimator(pictures(scene))
    wrong = error(motion.velocity, scene)
    assert np.isfinite(motion.velocity).all() and 0 <= motion.confidence.min() and motion.confidence.max() <= 1
    assert np.median(wrong) < 0.01
    assert np.median(wrong[motion.confidence > 0.7]) < 0.01
    assert wrong.mean() < 0.06


@pytest.mark.parametrize("estimator", [ILK(), TVL1()], ids=name)
def test_playback_flow_holds_at_one_pixel_per_frame(estimator, pictures, error):
    assert np.median(error(estimator(pictures("translate1.0")).velocity, "translate1.0")) < 0.03


def test_nothing_moves_is_found_exactly(pictures):
    for estimator in (Automatic(), Still()):
        motion = estimator(pictures("static"))
        assert not motion.velocity.any() and not motion.acceleration.any()


@pytest.mark.parametrize("scene", ["translate0.3", "affine"])
def test_automatic_takes_one_motion_where_one_is_enough(scene, pictures, error):
    motion = Automatic()(pictures(scene))
    np.testing.assert_array_equal(motion.velocity, Global()(pictures(scene)).velocity)
    assert error(motion.velocity, scene).max() < 0.005


def test_automatic_finds_the_object_and_the_background(pictures, recording, error):
    motion = Automatic()(pictures("object"))
    front = recording("object").scene.surface(50.0)[::2, ::2] > 0
    wrong = error(motion.velocity, "object")
    assert np.median(wrong[front]) < 0.01 and np.median(wrong[~front]) < 0.01


@pytest.mark.parametrize("estimator", MOVING, ids=name)
@pytest.mark.parametrize("axis", [0, 1])
def test_rows_come_first_and_down_and_right_are_positive(estimator, axis, central):
    # Dots drawn by hand, on even ground, all moving 0.2 px per frame along one axis; no simulator that could share a
    # mistake with the estimates.
    rng = np.random.default_rng(3)
    dots = rng.uniform(-15, 63, (60, 2))
    rows, columns = np.mgrid[0:48, 0:48]
    charge, spikes = rng.random((48, 48)), []
    for t in range(61):
        now = dots.copy()
        now[:, axis] += 0.2 * (t - 30)
        light = 0.3 + sum(0.6 * np.exp(-((rows - r) ** 2 + (columns - c) ** 2) / 8) for r, c in now)
        charge += 0.6 * light
        spikes.append(charge >= 1)
        charge -= charge >= 1
    velocity = estimator(central(motion_frames(np.array(spikes), key=30), 11)).velocity
    found = np.median(velocity, axis=(1, 2))
    assert found[axis] == pytest.approx(0.2, abs=0.02)
    assert abs(found[1 - axis]) < 0.02


def test_bad_pixels_do_not_disturb(recording, error):
    spikes = recording("translate0.3").spikes.copy()
    bad = np.zeros(spikes.shape[1:], bool)
    bad[:, 30:32] = bad[55] = bad[10:13, 80:83] = True
    spikes[:, :, 30:32], spikes[:, 55], spikes[:, 10:13, 80:83] = 0, 1, 1
    for estimator in (Automatic(), PhaseCorrelation()):
        motion = estimate_motion(spikes, key=50, estimator=estimator, bad_pixels=bad)
        assert error(motion.velocity, "translate0.3").max() < 0.01
    assert (
        np.median(error(estimate_motion(spikes, key=50, estimator=TVL1(), bad_pixels=bad).velocity, "translate0.3"))
        < 0.02
    )


@pytest.mark.parametrize("estimator", [Dense(), ILK(), TVL1()], ids=name)
def test_confidence_is_lower_where_there_is_no_texture(estimator):
    texture = gaussian_filter(np.random.default_rng(0).standard_normal((160, 160)), 1.5)
    picture = 0.5 + 0.12 * texture / texture.std()
    picture[:, 80:] = 0.5
    spikes = simulate(Translation(picture.clip(0, 1), (0.2, 0.0)), scale=2).spikes
    confidence = estimate_motion(spikes, key=50, estimator=estimator).confidence
    assert np.median(confidence[15:-15, 10:30]) > 0.8
    assert np.median(confidence[15:-15, 55:70]) < np.median(confidence[15:-15, 10:30]) / 2


@pytest.mark.parametrize("estimator", EVERY, ids=name)
@pytest.mark.parametrize("shape", [(40, 1, 1), (40, 3, 5), pytest.param((40, 1, 40), marks=pytest.mark.slow)])
def test_tiny_pictures(estimator, shape):
    spikes = np.random.default_rng(0).random(shape) < 0.3
    motion = estimate_motion(spikes, key=20, estimator=estimator)
    assert motion.velocity.shape == (2, *shape[1:])
    assert np.isfinite(motion.velocity).all() and np.isfinite(motion.confidence).all()


@pytest.mark.parametrize("estimator", [PhaseCorrelation(), ILK()], ids=name)
@pytest.mark.parametrize("frames", [1, 2, 5, 9])
def test_short_recordings(estimator, frames):
    spikes = np.random.default_rng(0).random((frames, 16, 18)) < 0.3
    for key in {0, frames // 2, frames - 1}:
        assert np.isfinite(estimate_motion(spikes, key=key, estimator=estimator).velocity).all()


@pytest.mark.parametrize("frames", [1, pytest.param(3, marks=pytest.mark.slow), 8])
def test_short_recordings_with_defaults(frames):
    spikes = np.random.default_rng(0).random((frames, 16, 18)) < 0.3
    assert np.isfinite(estimate_motion(spikes, key=frames - 1).velocity).all()


@pytest.mark.parametrize("estimator", EVERY, ids=name)
@pytest.mark.parametrize("value", [0, 1])
def test_nothing_is_seen_moving_where_nothing_is_seen(estimator, value, central):
    motion = estimator(central(motion_frames(np.full((61, 48, 48), value, np.uint8), key=30), 11))
    assert np.abs(motion.velocity).max() < 1e-3


@pytest.mark.parametrize("estimator", EVERY, ids=name)
def test_noise_gives_finite_velocities(estimator, central):
    motion = estimator(central(motion_frames(np.random.default_rng(1).random((61, 48, 48)) < 0.4, key=30), 11))
    assert np.isfinite(motion.velocity).all() and np.isfinite(motion.acceleration).all()


@pytest.mark.parametrize("key", [0, 90])
def test_a_key_frame_near_an_end(key, recording):
    velocity = estimate_motion(recording("translate0.3").spikes, key=key, estimator=ILK()).velocity
    assert np.abs(np.median(velocity, axis=(1, 2)) - [0.18, -0.24]).max() < 0.02


def test_constant_two_numbers_are_the_velocity_everywhere():
    """`Motion.constant` takes the velocity as a tuple, a list or an array; its speed and acceleration agree with it."""
    for pair in ((0.5, -1.0), [0.5, -1], np.array([0.5, -1.0]), np.array([0.5, -1.0], np.float32)):
        motion = Motion.constant(pair, (4, 6))
        assert motion.velocity.shape == (2, 4, 6) and motion.velocity.dtype == np.float32
        assert (motion.velocity[0] == 0.5).all() and (motion.velocity[1] == -1.0).all()
        assert not motion.acceleration.any() and (motion.confidence == 1).all() and motion.layers is None
    assert validate_motion(Motion.constant((0, 0), (4, 6)), 4, 6).velocity.shape == (2, 4, 6)


@pytest.mark.parametrize(
    "wrong",
    [(1.0,), (1.0, 2.0, 3.0), (), (np.nan, 0.0), (0.0, np.inf), (1e39, 0.0), np.zeros((2, 4, 6)), np.zeros((2, 1))],
    ids=str,
)
def test_constant_other_than_two_finite_numbers_is_refused(wrong):
    with pytest.raises(InputError, match="it must be two finite numbers .down, right."):
        Motion.constant(wrong, (4, 6))


def test_of_velocity_keeps_the_field_and_is_validated_by_the_sensor():
    field = np.random.default_rng(0).standard_normal((2, 4, 6)).astype(np.float32)
    motion = Motion.of_velocity(field)
    np.testing.assert_array_equal(validate_motion(motion, 4, 6).velocity, field)
    with pytest.raises(InputError, match=r"motion.velocity has shape \(2, 4, 6\); for this recording it must be"):
        validate_motion(motion, 5, 6)
    field[0, 1, 2] = np.nan
    with pytest.raises(InputError, match="motion.velocity holds values that are not finite"):
        validate_motion(Motion.of_velocity(field), 4, 6)


def test_one_picture_cannot_be_compared(pictures):
    whole = pictures("static")
    one = MotionFrames(whole.picture[:1], whole.after[:1])
    for estimator in (PhaseCorrelation(), ILK(), TVL1()):
        with pytest.raises(InputError, match="at least two"):
            estimator(one)


@pytest.mark.parametrize(
    "make",
    [
        lambda: PhaseCorrelation(0),
        lambda: ILK(radius=0),
        lambda: ILK(warps=0),
        lambda: TVL1(0.0),
        lambda: TVL1(warps=0),
    ],
)
def test_settings_out_of_range(make):
    with pytest.raises(InputError, match="it must be a"):
        make()


def test_a_fixed_pattern_that_is_known_does_not_hold_the_motion_back():
    """A fixed pattern pulls a velocity towards zero: with the gains given, as little as without a pattern."""
    picture = gaussian_filter(np.random.default_rng(3).random((128, 128)), 3)
    picture = 0.5 + 0.1 * (picture - picture.mean()) / picture.std()
    scene = Translation(np.clip(picture, 0, 1), (0.06, -0.04), key=32)
    made = simulate(scene, scale=2, frames=65, sensor=Sensor(fixed_pattern=0.1), seed=1)
    true = np.array([0.03, -0.02])[:, None, None]

    def error(gain: np.ndarray | None) -> float:
        found = estimate_motion(made.spikes, key=32, white_rate=made.white_rate, estimator=Global(), gain=gain)
        return float(np.hypot(*(found.velocity - true)).mean())

    known, unknown = error(made.gain), error(None)
    print(f"velocity wrong by {known:.5f} with the gains, {unknown:.5f} without")
    assert 4 * known < unknown


@pytest.mark.parametrize("key", [50, 10])
def test_dense_follows_what_turns(key):
    """A point of a turning scene at r accelerates by −ω² r: here by up to 2 px over half of the recording."""
    turn = 0.006
    scene = Affine(data.camera()[100:340, 120:360] / 255, rotation=turn, key=key)
    motion = Dense()(motion_frames(simulate(scene, scale=2, seed=1).spikes, key=key))
    arm = np.indices(motion.speed.shape) - (np.array(motion.speed.shape)[:, None, None] - 1) / 2
    truth = np.stack([-(turn**2) * arm[0], -(turn**2) * arm[1]])
    inner = np.hypot(*arm) < 40  # in view all the time
    straight, followed = (
        np.median(np.hypot(*(a - truth))[inner]) * 50**2 / 2 for a in (0 * truth, motion.acceleration)
    )
    assert straight > 1.0
    assert followed < 0.4 * straight  # measured: 0.13 and, with the key frame near an end, 0.22


def test_dense_of_a_long_recording_is_finite():
    """Its pictures are further apart than the nearest times that the search begins with."""
    noise = np.random.default_rng(0).random((301, 40, 40)) < 0.3
    motion = Dense()(motion_frames(noise, key=150))
    assert np.isfinite(motion.velocity).all() and np.isfinite(motion.acceleration).all()


def test_dense_does_not_depend_on_jax_being_in_double_precision():
    made = simulate(Translation(data.camera()[100:180, 120:200] / 255, (0.14, -0.24), key=25), scale=2, frames=51)
    single = Dense()(motion_frames(made.spikes, key=25))
    with jax.enable_x64(True):
        double = Dense()(motion_frames(made.spikes, key=25))
    assert double.velocity.dtype == single.velocity.dtype == np.float32
    np.testing.assert_allclose(double.velocity, single.velocity, atol=1e-5)
    np.testing.assert_allclose(double.acceleration, single.acceleration, atol=1e-6)


# Pixels over half of the recording, mean: measured are 0.014 and 0.135; all that fits would be 0.17 and 0.79.
@pytest.mark.parametrize("sensor, bound", [(Sensor(), 0.05), (Sensor(white_rate=0.1, photons=25.0), 0.3)])
def test_dense_makes_little_acceleration_of_noise(sensor, bound):
    scene = Translation(data.camera()[100:340, 120:360] / 255, (0.14, -0.24), key=50)
    spikes = simulate(scene, scale=2, sensor=sensor, seed=1).spikes
    motion = Dense()(motion_frames(spikes, key=50, white_rate=sensor.white_rate))
    assert np.hypot(*motion.acceleration).mean() * 50**2 / 2 < bound
