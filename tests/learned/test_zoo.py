"""All models by name: one interface, one measure."""

import importlib
import subprocess
import sys
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import learned
from learned import load_model, zoo
from learned.evaluation import inference
from learned.evaluation.reference_problem import PRIOR, ReferenceProblem, read, reference_problem, reference_task
from learned.networks.restoration import RestorationConfig, RestorationNet
from learned.networks.spikesr import SpikeSRConfig, SpikeSRNet
from learned.networks.unrolled_ista import UnrolledConfig, UnrolledISTA
from learned.networks.unrolled_ista_pase import UnrolledPASE, UnrolledPASEConfig
from learned.networks.velocity import VelocityNet
from learned.training import checkpoint
from learned.zoo import Network, Optimizer, model, names
from scsr_opt import InputError, Recording, Status, reconstruct
from scsr_opt.motion.trajectory import Motion
from scsr_opt.pipeline import task
from scsr_opt.solvers import FISTA
from scsr_opt.solvers.problem import lipschitz_bound

TINY = {
    "blocks": 1, "length": 5, "spacing": 1, "branches": (1,), "encoder_channels": 2, "encoder_blocks": 0, "channels": 2,
    "proximal_channels": 2, "proximal_blocks": 0, "groups": 1, "levels": 0, "stages": 2, "gradient": False,
}  # fmt: skip
UNROLLED = {"stages": 2, "boundaries": (10,), "proximal": False}
PASE = {
    **UNROLLED, "moments": 3, "length": 5, "spacing": 12, "branches": (1,), "encoder_channels": 2, "encoder_blocks": 0,
}  # fmt: skip
RESTORATION: dict[str, Any] = {"channels": 2, "blocks": 0}


@pytest.fixture(scope="module")
def posed(recording) -> ReferenceProblem:
    return reference_problem(reference_task(recording, scale=2))


@pytest.fixture(scope="module")
def solution(recording):
    return reconstruct(recording, scale=2, prior=PRIOR, solver=FISTA())


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A SpikeSR-Net of identities, and steepest descent unrolled: on spike intervals, and on encoded spikes."""
    folder = tmp_path_factory.mktemp("shelf")
    build = eqx.filter_jit(lambda: SpikeSRNet(SpikeSRConfig.small(2, **TINY), key=jax.random.key(0, impl="unsafe_rbg")))
    net = build()
    net = eqx.tree_at(lambda n: n.stages, net, jax.tree.map(jnp.zeros_like, net.stages))
    card = checkpoint.Card("spikesr", {"scale": 2, "network": {"size": "small", **TINY}}, "none", 0, "none", {})
    checkpoint.save(folder / "spikesr-small-x2.scsr", net, card)
    net = UnrolledISTA(UnrolledConfig(2, **UNROLLED), key=jax.random.key(0))
    net = eqx.tree_at(lambda n: n.momenta, net, jnp.zeros_like(net.momenta))
    card = checkpoint.Card("unrolled", {"scale": 2, "network": UNROLLED}, "none", 0, "none", {})
    checkpoint.save(folder / "unrolled-x2.scsr", net, card)
    net = UnrolledPASE(UnrolledPASEConfig(2, **PASE), key=jax.random.key(0))
    card = checkpoint.Card("unrolled_pase", {"scale": 2, "network": PASE}, "none", 0, "none", {})
    checkpoint.save(folder / "unrolled-pase-x2.scsr", net, card)
    net = RestorationNet(RestorationConfig(2, **RESTORATION), key=jax.random.key(0))
    card = checkpoint.Card("restoration", {"scale": 2, "network": RESTORATION}, "none", 0, "none", {})
    checkpoint.save(folder / "ridge-centred-x2.scsr", net, card)
    return folder


@pytest.fixture
def shelf(files, monkeypatch):
    monkeypatch.setattr(zoo, "CHECKPOINTS", files)
    learned._model.cache_clear()
    yield files
    learned._model.cache_clear()


def network(name: str) -> Network:
    found = model(name, 2)
    assert isinstance(found, Network)
    return found


def test_which_models_can_be_used(shelf):
    optimizers = ["ista-tv", "fista-tv", "fista-huber", "ridge", "ridge-weakly"]
    assert names(2) == [*optimizers, "ridge-centred", "unrolled", "unrolled-pase", "spikesr-small"]
    assert names(3) == optimizers
    for name in names(2):
        assert model(name, 2).name == name


@pytest.mark.parametrize(("scale", "name"), [(2, "ridge"), (4, "fista-huber")])
def test_default_model_gives_the_picture_of_reconstruct(recording, scale, name):
    chosen, usual = model(name, scale)(recording, scale=scale), reconstruct(recording, scale=scale, solver=FISTA())
    np.testing.assert_array_equal(chosen.image, usual.image)
    assert [stage.objective for stage in chosen.stages] == [stage.objective for stage in usual.stages]


def test_what_is_posed_is_what_reconstruct_solves(posed, solution):
    """Strength and objective are those of `reconstruct`, and from its picture nothing is left to do."""
    assert float(posed.strength) == solution.diagnostics.strength
    reading = read(posed, jnp.asarray(solution.image))
    # The same sums in another program: rounding of float32 in a sum of some thousand terms of one sign.
    assert float(reading.data) == pytest.approx(solution.stages[-1].data, rel=1e-5)
    assert float(reading.objective) == pytest.approx(solution.stages[-1].objective, rel=1e-5)
    chosen = model("fista-huber", 2)
    assert isinstance(chosen, Optimizer)
    again = reconstruct(
        posed.task.recording,
        scale=2,
        key=posed.task.clip.key_frame,
        strength=float(posed.strength),
        prior=PRIOR,
        solver=FISTA(),
    )
    np.testing.assert_array_equal(chosen.solve(posed).image, again.image)
    again = chosen.solve(posed, start=solution.image)
    # Its dual variable, which a picture does not hold, is all that has to be found again.
    assert len(again.stages) < len(solution.stages) / 2
    assert again.stages[-1].objective == pytest.approx(solution.stages[-1].objective, rel=1e-4)


def test_motion_during_exposures_is_in_the_measure(monkeypatch):
    """f is that of the samples read along their exposures, at whatever picture it is evaluated."""
    rng = np.random.default_rng(0)
    dim = (rng.random((41, 20, 24)) < 0.08).astype(np.uint8)  # long exposures
    motion = Motion.of_velocity(np.broadcast_to(np.array([0.4, -0.6], np.float32)[:, None, None], (2, 20, 24)))
    monkeypatch.setattr(task, "motion_in", lambda *_: motion)
    posed = reference_problem(reference_task(dim, scale=2), strength=0.002)
    assert posed.placed.finest > 1
    for image in (posed.first, jnp.asarray(rng.random((40, 48)), jnp.float32)):
        missed = np.asarray(posed.placed.read(posed.plain.blurred(image)) - posed.placed.value, np.float64)
        exact = 0.5 * float(np.sum(missed**2 * np.asarray(posed.placed.weight, np.float64)))
        # Each of f's three parts is rounded to seven digits, and they cancel by a factor of ten at most.
        assert float(read(posed, image).data) == pytest.approx(exact, rel=1e-4)
        assert float(posed.plain.value(image)) != pytest.approx(exact, rel=1e-2)


def test_a_network_of_identities_stays_where_it_starts(shelf, recording, posed, solution):
    chosen = network("spikesr-small")
    found = chosen.solve(posed, start=solution.image, keep_images=True)
    assert found.status is Status.stages_done and found.status.usable and len(found.stages) == 2
    for stage in found.stages:
        np.testing.assert_array_equal(stage.image, solution.image)
        np.testing.assert_array_equal(stage.gradient_step, solution.image)
        assert stage.objective == pytest.approx(solution.stages[-1].objective, rel=1e-5)
        assert stage.objective == pytest.approx(stage.data + stage.prior, rel=1e-6)
        assert stage.step_size == 0  # it does not go along the gradient
        # What FISTA ended with bounds it but for the dual steps that it saved.
        assert stage.residual < 5 * max(solution.stages[-1].residual, 1e-4)
    own = chosen(recording, scale=2)
    assert own.status is Status.stages_done
    assert own.stages[-1].objective > 2 * solution.stages[-1].objective
    assert own.stages[-1].residual > 100 * found.stages[-1].residual
    assert own.diagnostics.iterations == len(own.stages) == 2 and own.diagnostics.strength == float(posed.strength)
    assert own.diagnostics.objective == own.stages[-1].objective and own.diagnostics.seconds["network"] > 0


def test_an_unrolled_iteration_reports_the_solvers_step_size(shelf, posed):
    found = model("unrolled", 2).solve(posed, start=posed.first, keep_images=True)
    β = 1 / float(lipschitz_bound(posed.plain))
    for stage in found.stages:
        assert stage.step_size == pytest.approx(β, rel=1e-4)
        np.testing.assert_array_equal(stage.image, stage.gradient_step)
    start = posed.first - β * read(posed, posed.first).slope
    assert found.stages[0].image == pytest.approx(np.asarray(start), abs=1e-6)  # intensities near 1, a few roundings


def test_encoded_spikes_are_measured_by_the_same_problem(shelf, posed, solution):
    found = model("unrolled-pase", 2).solve(posed, start=solution.image, keep_images=True)
    assert found.status is Status.stages_done and len(found.stages) == 2
    first = found.stages[0]
    assert first.image is not None and np.linalg.norm(first.image - solution.image) > 0
    assert first.objective > solution.stages[-1].objective  # it goes to what its encoder measured
    assert first.objective == pytest.approx(float(read(posed, jnp.asarray(first.image)).objective), rel=1e-6)


def test_a_network_is_compiled_to_need_little_memory(monkeypatch):
    assert set(inference.sparing()) == {"xla_cpu_scheduler_type"}  # this version of XLA knows the option

    def refuses(*_: Any, **__: Any) -> Any:
        raise jax.errors.JaxRuntimeError("INVALID_ARGUMENT: No such compile option")

    again = inference.sparing.__wrapped__
    with monkeypatch.context() as changed:
        changed.setattr(jax.stages.Lowered, "compile", refuses)
        assert again() == {}  # another one may not
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert again() == {}


def test_functions_by_name(shelf, recording):
    spikes = np.asarray(recording.spikes)
    function = importlib.import_module("learned").spikesr_small
    found = function(spikes, scale=2, key=20, white_rate=0.6)
    assert found.stages == ()  # the time is the network's own
    np.testing.assert_array_equal(found.image, network("spikesr-small")(spikes, scale=2, record=False).image)
    assert learned.unrolled(spikes, scale=2, key=20, white_rate=0.6).image.shape == (40, 48)
    centred = learned.ridge_centred(spikes, scale=2, key=20, white_rate=0.6)
    assert centred.status.usable and centred.diagnostics.first_iterations > 0
    with pytest.raises(InputError, match="no weights of spikesr-full for scale 2"):
        learned.spikesr_full(spikes, scale=2)


def test_the_package_is_imported_at_once():
    program = "import sys, learned; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


def test_a_recording_of_darkness(shelf):
    dark = np.zeros((41, 20, 24), np.uint8)
    for name in ("fista-huber", "spikesr-small"):
        found = model(name, 2)(dark, scale=2)
        assert found.status is Status.no_samples and found.image.shape == (40, 48) and not found.image.any()
    assert learned.spikesr_small(dark, scale=2).status is Status.no_samples


def test_networks_see_the_nearest_good_pixel_in_the_place_of_a_bad_one(recording):
    bad = np.zeros((20, 24), bool)
    bad[3, 0] = bad[4, 0] = True
    spikes = np.array(recording.spikes)
    spikes[:, bad] = 1
    marked = Recording.from_array(spikes, bad_pixels=bad)
    seen = inference.plausible_spikes(reference_task(marked, scale=2).clip)
    np.testing.assert_array_equal(seen[:, ~bad], spikes[:, ~bad])
    neighbours = [spikes[:, row, column] for row, column in ((2, 0), (3, 1))]
    assert any((seen[:, 3, 0] == other).all() for other in neighbours)


def test_a_picture_that_is_not_finite_is_not_handed_on(tmp_path, shelf, posed):
    net, card = checkpoint.load(shelf / "unrolled-x2.scsr")
    broken = eqx.tree_at(lambda n: n.log_factors, net, jnp.asarray([0.0, jnp.nan]))
    checkpoint.save(tmp_path / "broken.scsr", broken, card)
    found = model(str(tmp_path / "broken.scsr"), 2).solve(posed)
    assert found.status is Status.non_finite and np.isfinite(found.image).all() and found.image.any()


def test_what_cannot_be(shelf, tmp_path, recording, posed):
    with pytest.raises(InputError, match="There is no model 'magic': take one of ista-tv"):
        model("magic", 2)
    for name in ("spikesr-small", "spikesr-small-x", "spikesr-small-x0", "spikesr-small_x2", "x2", ""):
        with pytest.raises(InputError, match=f"There is no model '{name}': an id is a name and a scale"):
            load_model(name)
    with pytest.raises(InputError, match="There is no model 'magic': take one of ista-tv"):
        load_model("magic-x2")
    with pytest.raises(InputError, match="scale is 4, but ridge-x2 is a model for scale 2"):
        load_model("ridge-x2")(recording, scale=4)
    with pytest.raises(InputError, match=r"for scale 4 \(shipped are: ridge-centred-x2, spikesr-small-x2, "):
        model("spikesr-small", 4)
    with pytest.raises(InputError, match="cannot be read"):
        model(str(tmp_path / "none.scsr"), 2)
    part = VelocityNet(2, key=jax.random.key(0, impl="unsafe_rbg"))
    configuration = {"scale": 2, "network": {"channels": 2}}
    checkpoint.save(tmp_path / "part.scsr", part, checkpoint.Card("velocity", configuration, "none", 0, "none", {}))
    with pytest.raises(InputError, match="The stages of velocity are not known; take a SpikeSR-Net"):
        model(str(tmp_path / "part.scsr"), 2)
    with pytest.raises(InputError, match="was trained for scale 2, but scale 3 is wanted"):
        network(str(shelf / "unrolled-x2.scsr"))(recording, scale=3, record=False)
    for name in ("fista-huber", "unrolled"):
        with pytest.raises(InputError, match=r"start has shape \(20, 24\)"):
            model(name, 2).solve(posed, start=np.zeros((20, 24), np.float32))
    with pytest.raises(InputError, match="white_rate"):
        reference_task(recording, scale=2, white_rate=-1)
    with pytest.raises(InputError, match="strength"):
        reference_problem(reference_task(recording, scale=2), strength=-1)
