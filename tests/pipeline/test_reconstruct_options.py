"""Options of `reconstruct` beside its defaults: each does what it is for, on small recordings."""

import re
from dataclasses import replace

import numpy as np
import pytest
from skimage import data

from scsr_opt import InputError, Shortcuts, Status, reconstruct, reconstruct_sequence
from scsr_opt.calibration.settings import GainSettings
from scsr_opt.camera import Intervals, Noise, Sensor, Simulation, Windows, simulate
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.motion import Global, Layers, Motion, Trust
from scsr_opt.operators import Blur, Huber, Welsch
from scsr_opt.pipeline import task, updates
from scsr_opt.pipeline.settings import PipelineSettings
from scsr_opt.priors import Bounded, HuberTotalVariation, TotalVariation, WaveletL1
from scsr_opt.solvers import ADMM, FISTA, LBFGS, CondatVu, DualityGap

PICTURE = data.camera()[110:158, 190:238]
FRAMES, SCALE, KEY = 41, 2, 20
VELOCITY = (0.11, -0.17)  # so fast that exposures are sampled at several positions, and corrected
MOTION, STILL = Motion.constant(VELOCITY, (24, 24)), Motion.none(24, 24)


def panning(**sensor: float) -> Simulation:
    """24x24 sensor pixels."""
    scene = Translation(PICTURE, velocity=(VELOCITY[0] * SCALE, VELOCITY[1] * SCALE), key=KEY)
    return simulate(scene, scale=SCALE, frames=FRAMES, sensor=Sensor(photons=1000.0, **sensor), seed=3)


@pytest.fixture(scope="module")
def made() -> Simulation:
    return panning()


@pytest.fixture(scope="module")
def usual(made):
    """The defaults, but for the motion, which is known."""
    return reconstruct(made.spikes, scale=SCALE, motion=MOTION)


def test_reconstruct_motion_is_taken_as_it_is(made, usual):
    """By one velocity, by a field of it, and as it came out of a solution."""
    field = np.empty((2, *made.spikes.shape[1:]), np.float32)
    field[0], field[1] = VELOCITY
    assert usual.motion is not MOTION  # a copy, which the caller may write to
    np.testing.assert_array_equal(usual.velocity, field)
    for motion in (Motion.of_velocity(field), usual.motion):
        again = reconstruct(made.spikes, scale=SCALE, motion=motion)
        np.testing.assert_array_equal(again.image, usual.image)


def score(made: Simulation, image: np.ndarray) -> float:
    return psnr(made.truth(KEY), image, 6)


# ---- samples ---------------------------------------------------------------------------------------------------------


def test_reconstruct_windows_are_counts():
    """A scene at rest at sensor resolution without a prior: the picture is the count of all whole windows."""
    spikes = simulate(Static(PICTURE), scale=2, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=1).spikes
    solution = reconstruct(spikes, scale=1, motion=STILL, samples=Windows(9), strength=0)
    assert solution.diagnostics.samples == 4 * spikes[0].size
    scene = solution.scene
    assert scene is not None and (scene.merged_for == 1).all()
    assert "instead" not in "".join(scene.lines())
    np.testing.assert_allclose(solution.image, spikes[:36].mean(0) / 0.6, atol=1e-3)


def test_reconstruct_ends_are_samples_of_their_own(made):
    still = {"scale": 1, "motion": STILL}
    with_ends, without = (
        reconstruct(made.spikes, samples=Intervals(ends), **still).diagnostics.samples for ends in (0.1, 0)
    )
    assert with_ends - without == 2 * (made.spikes.any(0)).sum() + (~made.spikes.any(0)).sum()


def test_noise_weighs_samples(made):
    """Only the weights change: where the noise of all light is the same, to those of duration."""
    still = {"scale": 1, "motion": STILL, "strength": 0.01, "solver": FISTA(tolerance=1e-5)}
    alike, shot = Noise(photons=1e-9, dark_rate=1e9), Noise(photons=25.0)  # 10⁹ of dark charge drown what differs
    by_duration, by_alike, by_shot = (
        reconstruct(made.spikes, samples=Intervals(noise=noise), **still).image for noise in (None, alike, shot)
    )
    np.testing.assert_allclose(by_alike, by_duration, atol=1e-4)
    # Dark pixels have less shot noise, so that the prior moves them less and bright ones more.
    bare = reconstruct(made.spikes, scale=1, motion=STILL, strength=0).image
    dark = bare < np.median(bare)
    moved, moved_before = (np.abs(image - bare) for image in (by_shot, by_duration))
    assert moved[dark].mean() < 0.9 * moved_before[dark].mean()
    assert moved[~dark].mean() > moved_before[~dark].mean()


# ---- robust losses ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("loss", "gained"), [(Huber(), 3), (Welsch(), 8)])
def test_robust_losses_overcome_hot_pixels(made, loss, gained):
    """9 of 576 pixels fire in every frame and nobody said so. Measured: 14.6 dB, Huber 19.0, Welsch 27.0.

    At one strength, which 576 pixels are too few to choose, and without gains, which take hot pixels for bright ones.
    """
    hot = made.spikes.copy()
    hot[:, 3::8, 5::8] = 1
    strength = reconstruct(made.spikes, scale=SCALE, motion=MOTION).diagnostics.strength
    common = {"scale": SCALE, "motion": MOTION, "strength": strength, "gain": None, "bad_pixels": None}
    squares, robust = (reconstruct(hot, robust=r, **common).image for r in (None, loss))
    assert score(made, robust) > score(made, squares) + gained


def test_a_loss_that_never_leaves_the_square_changes_nothing(made):
    """At rest there are no other corrections: the rounds solve the same problem again and end where it is solved."""
    still = {"scale": 1, "motion": STILL}
    plain = reconstruct(made.spikes, **still)
    same = reconstruct(made.spikes, robust=Huber(1e6), strength=plain.diagnostics.strength, **still)
    assert plain.diagnostics.positions == same.diagnostics.positions == 1
    # Two ends within the tolerance of 1e-4 per step; convergence adds a factor of ten.
    np.testing.assert_allclose(same.image, plain.image, atol=3e-3)


# ---- gain ------------------------------------------------------------------------------------------------------------


def test_reconstruct_gains_known_or_found_beat_none():
    """Gains that spread by 10 %. Measured: 33.5 dB with them, 32.9 with those that were found, 32.6 without: there a
    strength held against pixels as a whole smooths most of them away."""
    made = panning(fixed_pattern=0.1)
    found, usual, known, ignored = (
        reconstruct(made.spikes, scale=SCALE, motion=MOTION, gain=gain) for gain in ("blind", "auto", made.gain, None)
    )
    np.testing.assert_array_equal(usual.image, found.image)
    assert score(made, known.image) > score(made, ignored.image) + 0.7
    assert score(made, found.image) > score(made, ignored.image) + 0.2
    again, first = found.diagnostics.strength, ignored.diagnostics.strength
    assert again is not None and first is not None and again < 0.8 * first  # validated again, without the pattern
    spread = found.diagnostics.gain_spread
    assert spread is not None and 0.03 < spread < 0.1 and known.diagnostics.gain_spread is None
    assert [stage.number for stage in found.stages] == list(range(1, len(found.stages) + 1))


def test_blind_gains_mend_the_motion():
    """A pattern rests: it pulls the velocity towards zero until its gains are known (a sixth of the error, here)."""
    scene = Translation(data.grass()[:160, :160], (0.06, -0.04), key=40)
    made = simulate(scene, scale=2, frames=81, sensor=Sensor(fixed_pattern=0.1), seed=1)

    def error(gain) -> float:
        found = reconstruct(made.spikes, scale=2, motion=Global(), gain=gain).velocity
        assert found is not None
        return float(np.hypot(*(found - np.array([0.03, -0.02])[:, None, None])).mean())

    found, ignored = error("blind"), error(None)
    print(f"velocity wrong by {found:.5f} with the gains found, {ignored:.5f} without")
    assert 3 * found < ignored


def test_gains_behind_a_robust_fit_do_not_mislead():
    """Samples that counted little for the picture count as little for the gains. Measured: 31.52 dB without gains,
    31.55 with them; 30.4 where all samples had the same say."""
    scene = Translation(data.camera()[100:220, 150:270] / 255, (0.1, 0.24))
    made = simulate(scene, scale=2, sensor=Sensor(fixed_pattern=0.05), seed=0)
    motion = Motion.constant((0.05, 0.12), made.spikes.shape[1:])
    found, ignored = (
        reconstruct(made.spikes, scale=2, motion=motion, robust=Huber(), gain=gain) for gain in ("blind", None)
    )
    assert (found.diagnostics.gain_spread or 0) > GainSettings().pattern_spread
    assert psnr(made.truth(50.0), found.image, 8) > psnr(made.truth(50.0), ignored.image, 8) - 0.1


def test_reconstruct_gains_at_rest_are_for_what_rests(made, monkeypatch):
    """A gain found in a still scene says nothing of a pixel that something passes."""
    velocity = np.zeros((2, 24, 24), np.float32)
    velocity[1, :12] = 0.2
    handed_on = []
    measure = task.measure

    def watched(*arguments, gain=None, **options):
        handed_on.append(gain)
        return measure(*arguments, gain=gain, **options)

    monkeypatch.setattr(task, "measure", watched)
    monkeypatch.setattr(task, "gain_at_rest", lambda *_, **__: np.full((24, 24), 1.5))
    motion = Motion.of_velocity(velocity)
    reconstruct(made.spikes, scale=SCALE, motion=motion, solver=FISTA(iterations=1), strength=1e-3)
    assert (handed_on[0][:12] == 1).all() and (handed_on[0][12:] == 1.5).all()


def test_gains_that_do_not_spread_are_left_alone(made, usual):
    without = reconstruct(made.spikes, scale=SCALE, motion=MOTION, gain=None)
    np.testing.assert_array_equal(usual.image, without.image)
    assert usual.diagnostics.gain_spread < GainSettings().pattern_spread


def test_gain_update_pattern_that_some_pixels_show_is_looked_for_in_all(monkeypatch, made, usual):
    """The spread of a few gains is known to 6 %: by chance it may be above what asks for another solve."""
    looked_at = []

    def spread(gain, known):
        looked_at.append(int(known.sum()))
        return 0.1 if len(looked_at) == 1 else 0.001

    monkeypatch.setattr(updates, "spread_of", spread)
    settings = PipelineSettings(gain=GainSettings(probed_pixels=20))
    found = reconstruct(made.spikes, scale=SCALE, motion=MOTION, settings=settings)
    assert looked_at[0] <= 20 < looked_at[1] == 24 * 24 and found.diagnostics.gain_spread == 0.001
    np.testing.assert_array_equal(found.image, usual.image)


def test_gains_of_one_change_nothing(made, usual):
    same = reconstruct(made.spikes, scale=SCALE, motion=MOTION, gain=np.ones((24, 24)))
    np.testing.assert_array_equal(same.image, usual.image)


# ---- optics ----------------------------------------------------------------------------------------------------------


def test_reconstruct_lens_estimated_beats_none():
    """σ = 0.8 sensor pixels. Measured: 0.75; 28.4 dB without a lens, 30.4 with either."""
    made = panning(psf_sigma=0.8 * SCALE)
    without, estimated = (
        reconstruct(made.spikes, scale=SCALE, motion=MOTION, optics=optics) for optics in (None, "estimate")
    )
    assert estimated.diagnostics.optics_sigma == pytest.approx(0.8, abs=0.25)  # the grid's spacing
    assert score(made, estimated.image) > score(made, without.image) + 1
    sigma = estimated.diagnostics.optics_sigma
    assert sigma is not None
    given = Blur.gaussian(without.image.shape, sigma * SCALE)
    same = reconstruct(made.spikes, scale=SCALE, motion=MOTION, optics=given)
    np.testing.assert_array_equal(same.image, estimated.image)


@pytest.mark.parametrize(
    ("spikes", "motion"),
    [(np.ones((9, 24, 24), np.uint8), STILL), (np.ones((9, 5, 5), np.uint8), Motion.constant((1.0, 1.0), (5, 5)))],
    ids=["at rest", "few pixels"],
)
def test_reconstruct_lens_that_cannot_be_estimated_is_refused(spikes, motion):
    with pytest.raises(InputError, match="it takes 100 pixels and a motion by 1 to tell a lens from a soft picture"):
        reconstruct(spikes, scale=2, motion=motion, optics="estimate")


# ---- motion and picture in turns -------------------------------------------------------------------------------------


def test_reconstruct_refined_motion_is_nearer_to_the_true_one(made):
    """A velocity that is wrong by 0.028 sensor pixels per frame. Measured: 0.003 after two rounds, 32.0 → 32.5 dB."""
    wrong = (0.09, -0.15)
    motion = Motion.constant(wrong, (24, 24))
    taken, refined = (reconstruct(made.spikes, scale=SCALE, motion=motion, refine=rounds) for rounds in (0, 2))
    assert taken.velocity is not None and refined.velocity is not None
    assert taken.velocity[:, 5, 5] == pytest.approx(wrong)
    off = np.hypot(*(refined.velocity - np.array(VELOCITY)[:, None, None]))
    assert off.max() < 0.01
    assert score(made, refined.image) > score(made, taken.image) + 0.2


# ---- going on --------------------------------------------------------------------------------------------------------


def test_going_on_from_a_solution(made, usual):
    again = reconstruct(made.spikes, scale=SCALE, motion=MOTION, state=usual.state)
    assert again.status is Status.converged and len(again.stages) < len(usual.stages) / 2
    # Both ends are within a few steps of the tolerance of the same minimiser. The objective is flat there: it differs
    # by the square of that, and by rounding, which processors do differently (measured: 0.5 %, 2e-7 and 2.4e-6 of it).
    assert again.diagnostics.objective <= usual.diagnostics.objective * (1 + 1e-5)
    assert np.linalg.norm(again.image - usual.image) < 0.01 * np.linalg.norm(usual.image)


def test_reconstruct_state_of_rest_and_motion_go_on_as_each_other(made):
    """At rest all pixels have one step size, else each has its own; neither is asked for again."""
    options = {"scale": SCALE, "prior": HuberTotalVariation(), "strength": 1e-3}
    moving, resting = (reconstruct(made.spikes, motion=of, **options) for of in (MOTION, STILL))
    assert moving.state.step_size.shape == moving.image.shape and resting.state.step_size.shape == ()
    for one, other, motion in ((moving, resting, MOTION), (resting, moving, STILL)):
        again = reconstruct(made.spikes, motion=motion, state=other.state, **options)
        assert again.status is Status.converged
        assert np.linalg.norm(again.image - one.image) < 0.01 * np.linalg.norm(one.image)


def test_reconstruct_limit_of_iterations_holds_for_all_corrections_together(made):
    few = {"scale": SCALE, "motion": MOTION, "solver": FISTA(8, tolerance=0), "strength": 1e-3}
    first = reconstruct(made.spikes, **few)
    assert (first.diagnostics.positions or 0) > 1 and len(first.stages) == 8
    second = reconstruct(made.spikes, state=first.state, **few)
    assert len(second.stages) == 8 and second.stages[-1].objective < first.stages[-1].objective
    assert second.diagnostics.objective == second.stages[-1].objective


@pytest.mark.parametrize(
    ("change", "asked"),
    [
        ({"solver": ADMM()}, "ADMM with RidgeRegulariser cannot start a picture of (48, 48)"),
        ({"prior": WaveletL1()}, "FISTA with WaveletL1"),
        ({"prior": Bounded(TotalVariation())}, "FISTA with Bounded"),
        ({"scale": 3}, "FISTA with RidgeRegulariser cannot start a picture of (72, 72)"),
        ({"state": "nothing"}, "FISTA with RidgeRegulariser"),
    ],
)
def test_a_state_that_does_not_fit(made, usual, change, asked):
    arguments = {"scale": SCALE, "motion": MOTION, "state": usual.state, **change}
    with pytest.raises(InputError, match=re.escape(asked)):
        reconstruct(made.spikes, **arguments)


# ---- solvers and priors ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [ADMM(), CondatVu(), LBFGS()])
def test_other_solvers_find_the_same_picture(made, solver):
    prior = HuberTotalVariation()
    fista, other = (
        reconstruct(made.spikes, scale=SCALE, motion=MOTION, prior=prior, strength=0.002, solver=s)
        for s in (FISTA(), solver)
    )
    assert other.status.usable
    # All stop within their tolerance, a few times 1e-4 in the picture's norm for each step (measured: 0.2 %).
    assert np.linalg.norm(fista.image - other.image) < 0.01 * np.linalg.norm(fista.image)
    assert other.diagnostics.objective == pytest.approx(fista.diagnostics.objective, rel=1e-3)


def test_bounds_hold(made, usual):
    assert usual.image.max() > 0.7
    solution = reconstruct(made.spikes, scale=SCALE, motion=MOTION, prior=Bounded(TotalVariation(), 0.2, 0.7))
    assert solution.image.min() == pytest.approx(0.2) and solution.image.max() == pytest.approx(0.7)


def test_a_prior_with_kinks_is_refused_by_smooth_solvers(made):
    with pytest.raises(InputError, match="LBFGS was given TotalVariation, which has kinks"):
        reconstruct(made.spikes, scale=1, motion=STILL, prior=TotalVariation(), solver=LBFGS())


# ---- in general ------------------------------------------------------------------------------------------------------


def test_other_numbers_compile_nothing(made, monkeypatch):
    traced = []
    original = FISTA.step

    def counted(self, problem, state):
        traced.append(self)
        return original(self, problem, state)

    options = {"scale": SCALE, "motion": MOTION, "robust": Welsch(), "gain": "blind"}
    reconstruct(made.spikes, **options)
    monkeypatch.setattr(FISTA, "step", counted)
    reconstruct(made.spikes, **options, strength=0.01, solver=FISTA(50, tolerance=1e-3))
    assert traced == []


@pytest.mark.usefixtures("types_unchecked")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"options": 3}, "options is 3; it must be a Options, such as Options(strength=0.01)."),
        ({"motion": "fast"}, "motion is 'fast'; it must be a Motion, such as Motion.constant((0.1, 0.2), (8, 9)) or"),
        ({"motion": VELOCITY}, "motion is (0.11, -0.17); it must be a Motion, such as Motion.constant("),
        ({"motion": Motion.none(5, 5)}, "motion.velocity has shape (2, 5, 5); for this recording it must be (2, 8, 9)"),
        ({"robust": "huber"}, "robust is 'huber'; it must be a Loss, such as Huber()."),
        ({"solver": "fista"}, "solver is 'fista'; it must be a Solver, such as FISTA()."),
        ({"solver": FISTA(stopping=DualityGap())}, "DualityGap was asked of RidgeRegulariser"),
        ({"prior": FISTA()}, "it must be a Prior, such as HuberTotalVariation()."),
        ({"prior": TotalVariation(), "solver": LBFGS()}, "LBFGS was given TotalVariation, which"),
        ({"samples": 9}, "samples is 9; it must be a SamplingRule, such as Intervals()."),
        ({"optics": 0.5}, "optics is 0.5; it must be a Blur, such as Blur.gaussian(shape, sigma), or 'estimate'."),
        ({"shortcuts": False}, "shortcuts is False; it must be a Shortcuts, such as Shortcuts.none()."),
        ({"keep_images": "no"}, "keep_images is 'no'; it must be True or False."),
        ({"refine": 1.5}, "refine is 1.5; it must be a whole number, at least 0."),
        ({"key": 2.0}, "key is 2.0; it must be a whole number, from 0 to 30."),
    ],
    ids=str,
)
def test_reconstruct_option_of_another_kind_is_refused(options, message):
    with pytest.raises(InputError, match=re.escape(message)):
        reconstruct(np.zeros((31, 8, 9), np.uint8), scale=2, **options)


SMALL, FIELDS, LABEL = np.zeros((2, 5, 5)), np.zeros((2, 2, 8, 9)), np.zeros((8, 9), int)


@pytest.mark.usefixtures("types_unchecked")
@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("", {"acceleration": SMALL}, "motion.acceleration has shape (2, 5, 5); for this recording it must be (2, 8,"),
        ("", {"confidence": np.full((8, 9), np.nan)}, "motion.confidence holds values that are not finite"),
        ("layers", {"velocity": SMALL[None]}, "motion.layers.velocity has shape (1, 2, 5, 5)"),
        ("layers", {"label": LABEL + 2}, "other numbers than those of the 2 layers, from 0."),
        ("layers", {"depth": np.zeros((2, 2))}, "motion.layers.depth is [[0.0, 0.0], [0.0, 0.0]]"),
        ("layers", {"depth": np.array([0, np.nan])}, "motion.layers.depth is [0.0, nan]; it must be"),
        ("layers", {"velocity": FIELDS + 1}, "motion.velocity or motion.acceleration is not that"),
        ("trust", {"share": SMALL}, "motion.trust.share has shape (2, 5, 5)"),
        ("trust", {"after": np.zeros(2)}, "motion.trust.after must be two or more times in frames, each"),
    ],
)
def test_reconstruct_motion_with_a_part_that_does_not_fit_is_refused(part, change, message):
    parts = {"layers": Layers(FIELDS, FIELDS, LABEL, np.arange(2)), "trust": Trust(np.arange(2.0), FIELDS[0])}
    motion = Motion.none(8, 9)
    changed = replace(motion, **change) if not part else replace(motion, **{part: replace(parts[part], **change)})
    with pytest.raises(InputError, match=re.escape(message)):
        reconstruct(np.zeros((31, 8, 9), np.uint8), scale=2, motion=changed)


@pytest.mark.usefixtures("types_unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Windows(0), "Windows was given a length of 0; it is a whole number of frames, 1 or more."),
        (lambda: Windows(2.5), "Windows was given a length of 2.5; it is a whole number of frames, 1 or more."),  # type: ignore
        (lambda: Intervals(2), "Intervals was given ends=2; it is a weight from 0 to 1."),
        (lambda: Intervals(ends=None), "Intervals was given ends=None; it is a weight from 0 to 1."),  # type: ignore
        (lambda: Intervals(noise=25), "noise is 25; it must be a Noise, such as Noise(photons=100.0)."),  # type: ignore
        (lambda: Noise(photons="x"), "photons is 'x', but it must be above 0, in photons per frame of white."),  # type: ignore
        (lambda: Huber("x"), "Huber was given the threshold 'x'; it is a number above 0, in standard deviations of"),  # type: ignore
        (lambda: Blur.gaussian((6, 9), (1.0, 2.0, 3.0)), "sigma of shape (3,); it is one number, or one each for rows"),  # type: ignore
        (lambda: FISTA(step_size=0.1), "FISTA was given step_size=0.1; it must be a StepSize, such as Separable()"),  # type: ignore
        (lambda: FISTA(stopping=1e-3), "FISTA was given stopping=0.001; it must be a Stopping, such as FixedPoint()."),  # type: ignore
        (lambda: FISTA(iterations=2.5), "FISTA was given 2.5 iterations; it needs a whole number of at least 1."),  # type: ignore
        (lambda: FISTA(iterations=float("nan")), "FISTA was given nan iterations; it needs a whole number"),  # type: ignore
        (lambda: CondatVu(balance=2.0), "CondatVu was given balance=2.0; it must be a Balance, such as Balance("),  # type: ignore
        (lambda: ADMM(linear_solve="cg"), "ADMM was given linear_solve='cg'; it must be a LinearSolve"),  # type: ignore
        (lambda: Shortcuts(simple_motion=1), "Shortcuts.simple_motion is 1; it must be True or False."),  # type: ignore
        (lambda: Motion.constant("ab", (8, 9)), "velocity is 'ab'; it must be two finite numbers (down, right)"),  # type: ignore
        (lambda: Motion.constant(0.5, (8, 9)), "velocity is 0.5; it must be two finite numbers (down, right)"),  # type: ignore
        (
            lambda: reconstruct_sequence(np.zeros((31, 8, 9), np.uint8), 5, scale=2),  # type: ignore
            "keys is 5; it must be the frames of the pictures: [50], or range(50, 100, 5).",
        ),
        (
            lambda: reconstruct_sequence(np.zeros((31, 8, 9), np.uint8), "5", scale=2),  # type: ignore
            "keys is '5'; it must be the frames of the pictures",
        ),
    ],
)
def test_parts_that_make_no_sense_are_refused(make, message):
    with pytest.raises(InputError, match=re.escape(message)):
        make()
