"""The training loop, with a network that is one convolution of the enlarged firing rate."""

import json
import os

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from learned.networks import inputs
from learned.training import checkpoint, configs, loop, prepared_cache, registry, validation
from learned.training.configs import TrainingConfig
from learned.training.loop import TrainingStatus, learning_rate, train
from learned.training.registry import Preparation, Trainable, trainable
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion
from scsr_opt.progress import NoProgress

CONFIG = TrainingConfig(
    "tiny", 2, 6, frames=11, patch=16, batch=2, rate=1e-2, schedule="cosine", warm_up=2, workers=0,
    scenes=("static", "translation"), validate_every=3, save_every=3,
)  # fmt: skip


def tiny(scale, network, *, poison=None) -> Trainable:
    """`poison(number of spikes)`: whether an example has a loss that is not a number."""

    def picture(model, spikes, white_rate):
        rate = jnp.mean(spikes.astype(jnp.float32), axis=0) / white_rate
        large = jnp.repeat(jnp.repeat(rate, scale, 0), scale, 1).astype(model.weight.dtype)
        return model(large[None])[0].astype(jnp.float32)

    def loss(model, example):
        error = jnp.mean(jnp.abs(picture(model, example.spikes, example.white_rate) - example.truth))
        return error if poison is None else jnp.where(poison(jnp.sum(example.spikes)), jnp.nan, error)

    return Trainable(lambda key: eqx.nn.Conv2d(1, 1, 3, padding=1, key=key), loss, picture)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(registry.MODELS, "tiny", tiny)


class Killed(NoProgress):
    """Interrupts the run after the given number of steps."""

    def __init__(self, after: int):
        self.left = after

    def advance(self, done: int) -> None:
        self.left -= done
        if self.left <= 0:
            raise KeyboardInterrupt


def test_a_killed_run_goes_on_to_the_same_result(tmp_path):
    straight = train(CONFIG, tmp_path / "straight")
    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, tmp_path / "killed", progress=Killed(5))
    assert checkpoint.read(tmp_path / "killed" / "state")[0]["steps"] == 3  # two steps are lost
    resumed = train(CONFIG, tmp_path / "killed")
    assert resumed.steps == straight.steps == 6 and resumed.validated == straight.validated
    assert resumed.losses.tobytes() == straight.losses.tobytes()
    names = sorted(str(p.relative_to(tmp_path / "straight")) for p in (tmp_path / "straight").rglob("*.*"))
    assert names == [
        "best.scsr", "curves.png", "last.scsr", "loss.csv", "samples/000003.png", "samples/000006.png",
        "validation.csv",
    ]  # fmt: skip
    for name in ("state", *names):  # to the last bit: weights, averages, optimiser, losses, pictures
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "straight" / name).read_bytes(), name


def test_a_run_starts_from_weights_that_are_named_and_goes_on_to_the_same_result(tmp_path):
    first = train(CONFIG.changed(steps=3), tmp_path / "first")
    config = CONFIG.changed(steps=4, seed=1, save_every=2, start=[str(tmp_path / "first" / "last.scsr")])
    kept = train(config.changed(rate=1e-12), tmp_path / "kept")
    assert np.allclose(kept.model.weight, first.model.weight, atol=1e-6)
    straight = train(config, tmp_path / "straight")
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "killed", progress=Killed(3))
    (tmp_path / "first" / "last.scsr").write_bytes((tmp_path / "kept" / "last.scsr").read_bytes())
    train(config, tmp_path / "killed")
    for name in ("state", "last.scsr"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "straight" / name).read_bytes(), name
    _, card = checkpoint.load(tmp_path / "straight" / "last.scsr")
    assert card.training["start"] == [{"file": "last.scsr", "model": "tiny", "steps": 3, "data": card.data}]
    assert straight.losses.tobytes() != kept.losses.tobytes()


PREPARED = CONFIG.changed(model="prepared", prepared=10, batch=4, validate_every=6, save_every=3)


@pytest.fixture
def made(monkeypatch) -> list[float]:
    """A network that is given the enlarged firing rate, and the sums of the truths of all examples made for it."""
    sums: list[float] = []

    def network_with_preparation(scale, network) -> Trainable:
        plain = tiny(scale, network)

        def make(example):
            sums.append(float(example.truth.sum()))
            rate = example.spikes.mean(0, dtype=np.float32) / example.white_rate
            return {"rate": rate.repeat(scale, 0).repeat(scale, 1), "truth": example.truth, "sum": np.float32(sums[-1])}

        def picture(model, given):
            return model(given["rate"].astype(jnp.float32)[None])[0]

        def loss(model, given):
            return jnp.mean(jnp.abs(picture(model, given) - given["truth"].astype(jnp.float32)))

        return plain._replace(loss=loss, preparation=Preparation(make, {"size": network.get("size", 1)}, picture))

    monkeypatch.setitem(registry.MODELS, "prepared", network_with_preparation)
    monkeypatch.setattr(validation, "KINDS", ("static",))
    return sums


def test_prepared_examples_are_made_once(tmp_path, made):
    train(PREPARED, tmp_path / "straight")
    shown = 2  # recordings of its kind
    assert len(made) == len(set(made)) == shown + 10
    with pytest.raises(KeyboardInterrupt):
        train(PREPARED, tmp_path / "killed", progress=Killed(8))
    assert len(made) == shown + 10 + shown + 8
    assert [path.name for path in sorted((tmp_path / "killed" / "examples").iterdir())] == ["000000.npz"]
    with pytest.raises(KeyboardInterrupt):
        train(PREPARED, tmp_path / "killed", progress=Killed(8 + 2 + 5))
    assert len(made) == 2 * (shown + 10) + shown  # two more examples, five steps
    train(PREPARED, tmp_path / "killed")
    assert len(made) == 2 * (shown + 10) + 2 * shown
    for name in ("state", "best.scsr", "examples/000000.npz", "examples/000008.npz"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "straight" / name).read_bytes(), name


def test_prepared_examples_come_in_turn(tmp_path, made):
    train(PREPARED.changed(steps=1), tmp_path)
    examples = made[2:]
    kept = prepared_cache.prepare(
        prepared_cache.Preparing(loop._examples(PREPARED), "prepared", 2, {}),
        10,
        tmp_path / "examples",
        json.loads(str(np.load(tmp_path / "examples" / "000000.npz")["made_of"])),
        workers=0,
    )
    assert [float(example["sum"]) for example in kept] == pytest.approx(examples)
    assert kept[0]["rate"].dtype == np.float16 and kept[0]["sum"].dtype == np.float32
    drawn = [b["sum"].tolist() for b in loop._drawn(kept, PREPARED.changed(steps=5), 0)]
    flat = sum(drawn, [])
    assert sorted(flat[:10]) == sorted(flat[10:]) == pytest.approx(sorted(examples)) and flat[:10] != flat[10:]
    assert [b["sum"].tolist() for b in loop._drawn(kept, PREPARED.changed(steps=5), 3)] == drawn[3:]


def test_prepared_examples_that_cannot_be_used(tmp_path, made):
    with pytest.raises(InputError, match="does not say how many: add an entry prepared"):
        train(PREPARED.changed(prepared=None), tmp_path)
    train(PREPARED.changed(steps=1), tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "a" / "examples").rename(tmp_path / "b" / "examples")
    with pytest.raises(InputError, match=r"000000\.npz was made with another configuration: seed is 0 there"):
        train(PREPARED.changed(seed=1), tmp_path / "b")
    (tmp_path / "b" / "examples" / "000008.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"000008\.npz is damaged or holds no prepared examples"):
        train(PREPARED, tmp_path / "b")


def test_a_killed_run_of_the_unrolled_iteration_goes_on_to_the_same_result(tmp_path, monkeypatch):
    """With a motion that is known, as compiling its estimate takes longest here."""
    monkeypatch.setattr(validation, "KINDS", ("static",))
    monkeypatch.setattr(inputs, "estimate_motion", lambda spikes, **_: Motion.none(*spikes.shape[1:]))
    config = CONFIG.changed(
        model="unrolled", network={"stages": 1, "channels": 2, "blocks": 0, "boundaries": [3]}, prepared=3,
        scenes=["static"],
    )  # fmt: skip
    straight = train(config, tmp_path / "straight")
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "killed", progress=Killed(3 + 5))  # examples are counted as well as steps
    resumed = train(config, tmp_path / "killed")
    assert resumed.steps == 6 and resumed.losses.tobytes() == straight.losses.tobytes()
    for name in ("state", "last.scsr", "best.scsr"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "straight" / name).read_bytes(), name
    model, _ = checkpoint.load(tmp_path / "straight" / "last.scsr")
    assert np.array_equal(model.log_factors, straight.model.log_factors) and np.any(model.log_factors != 0)


def test_a_finished_run_has_nothing_left_to_do_and_can_be_made_longer(tmp_path):
    config = CONFIG.changed(steps=3, schedule="constant")
    first = train(config, tmp_path)
    again = train(config, tmp_path)
    assert again.steps == 3 and again.losses.tobytes() == first.losses.tobytes()
    longer = train(config.changed(steps=5, workers=1), tmp_path)
    assert longer.steps == 5 and longer.losses[:3].tobytes() == first.losses.tobytes()
    with pytest.raises(InputError, match="has 5 steps behind it, but the configuration has 4"):
        train(config.changed(steps=4), tmp_path)
    with pytest.raises(InputError, match="another configuration: batch is 2 there, but 3 is wanted"):
        train(config.changed(steps=6, batch=3), tmp_path)
    (tmp_path / "state").write_bytes((tmp_path / "state").read_bytes()[:-9])
    with pytest.raises(InputError, match="damaged or cut short"):
        train(config.changed(steps=6), tmp_path)


def test_it_learns(tmp_path):
    """The mean of a 3×3 neighbourhood beats random weights: after 80 steps most of the error is gone."""
    config = CONFIG.changed(steps=80, rate=3e-2, ema_decay=0.9, validate_every=40, save_every=80)
    trained = train(config, tmp_path)
    assert trained.status is TrainingStatus.finished and trained.skipped == 0
    assert trained.losses[-10:].mean() < 0.5 * trained.losses[:5].mean()
    model, card = checkpoint.load(tmp_path / "last.scsr")
    assert np.array_equal(model.weight, trained.model.weight)
    assert card.steps == 80 and card.scores["psnr"] == trained.validated[-1]["psnr"] > 15
    assert "80 steps, 0 of them skipped" in trained.lines()[0] and "playback enlarged" in trained.lines()[1]
    best = max(row["psnr"] for row in trained.validated)
    assert checkpoint.load(tmp_path / "best.scsr")[1].scores["psnr"] == best


def test_half_precision_computes_in_it_and_keeps_float32(tmp_path):
    full, half = (
        train(CONFIG.changed(precision=precision), tmp_path / precision) for precision in ("float32", "bfloat16")
    )
    assert half.model.weight.dtype == jnp.float32
    # bfloat16 has 8 significant bits; ten operations in a row stay within a few per cent.
    assert half.losses == pytest.approx(full.losses, rel=0.05)
    assert half.losses.tobytes() != full.losses.tobytes()


def test_a_step_without_a_finite_loss_is_skipped_and_counted(tmp_path, monkeypatch):
    examples = loop._examples(CONFIG)
    poisoned = int(examples[2 * CONFIG.batch].spikes.sum())  # the third step's first example
    monkeypatch.setitem(registry.MODELS, "tiny", lambda s, n: tiny(s, n, poison=lambda total: total == poisoned))
    config = CONFIG.changed(steps=3, validate_every=2, save_every=2)
    trained = train(config, tmp_path / "a")
    assert trained.skipped == 1 and np.isfinite(trained.losses).tolist() == [True, True, False]
    # The skipped step changed nothing: what was validated after two steps is what came out.
    assert trained.validated[1] == trained.validated[0] | {"step": 3}
    assert checkpoint.load(tmp_path / "a" / "best.scsr")[1].steps == 2


def test_too_many_of_them_end_the_run(tmp_path, monkeypatch):
    monkeypatch.setitem(registry.MODELS, "tiny", lambda s, n: tiny(s, n, poison=lambda total: total >= 0))
    trained = train(CONFIG.changed(steps=100, validate_every=100, save_every=100), tmp_path)
    assert trained.status is TrainingStatus.diverged and not trained.status.usable
    assert trained.steps == trained.skipped == 20 and "lower rate" in trained.status.message
    assert not (tmp_path / "state").exists()  # an earlier one would have been left as it was


def test_learning_rates():
    def at(*steps, **fields):
        rate = learning_rate(CONFIG.changed(steps=100, rate=1.0, **fields))
        return [float(rate(step)) for step in steps]

    assert at(0, 50, 99, schedule="constant") == [1, 1, 1]
    assert at(0, 9, 10, 20, schedule="halving", halve_every=10) == [1, 1, 0.5, 0.25]
    cosine = at(0, 5, 10, 55, 100, schedule="cosine", warm_up=10)
    assert cosine == pytest.approx([0, 0.5, 1, 0.505, 0.01], abs=1e-6)
    assert at(0, schedule="cosine", warm_up=0) == [1]


@pytest.mark.parametrize("name", configs.names())
def test_configurations_that_come_along(name):
    config = TrainingConfig.read(name)
    assert TrainingConfig.of(config.plain()) == config
    assert name in ("smoke", "velocity") or name.endswith(f"x{config.scale}")
    task = trainable(config.model, config.scale, config.network)  # the sizes are ones that the network has
    assert (task.preparation is None) == (config.prepared is None)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"colour": "red"}, "has an entry 'colour', which is not known: allowed are model, scale, steps"),
        (
            {"scale": 0},
            "scale is 0, but it must be a whole number of at least 1, pixels of the picture per sensor pixel",
        ),
        ({"batch": 1.5}, r"batch is 1\.5, but it must be a whole number"),
        ({"batch": True}, "batch is True"),
        ({"rate": -1.0}, r"rate is -1\.0, but it must be a number above 0"),
        ({"rate": float("nan")}, "rate is nan"),
        ({"rate": "fast"}, "rate is 'fast'"),
        ({"schedule": "steep"}, "schedule is 'steep', but it must be one of constant, halving, cosine"),
        ({"precision": "float16"}, "precision is 'float16', but it must be one of float32, bfloat16"),
        ({"ema_decay": 1}, "ema_decay is 1, but it must be a number from 0 to below 1"),
        ({"scenes": ["train"]}, r"scenes is \('train',\), but it must be a list of at least one of static"),
        ({"lights": "day"}, "lights is 'day', but it must be a list"),
        ({"patch": 8}, "patch is 8, but it must be a whole number of at least 16, sensor pixels"),
        ({"network": 3}, "network is 3, but it must be a table of sizes"),
        ({"workers": -1}, "workers is -1"),
        ({"start": []}, r"start is \(\), but it must be a list of names of shipped weights or paths"),
        ({"prepared": 0}, "prepared is 0, but it must be a whole number of at least 1, examples"),
    ],
)
def test_configurations_that_are_refused(entries, message):
    with pytest.raises(InputError, match=message):
        TrainingConfig.of({"model": "tiny", "scale": 2, "steps": 1} | entries)


def test_files_that_are_no_configuration(tmp_path):
    with pytest.raises(
        InputError, match="There is no configuration tall-x3: .* one of compensation-x2, .*smoke, spikesr-full-x2"
    ):
        TrainingConfig.read("tall-x3")
    (tmp_path / "a.toml").write_text("scale = \n")
    with pytest.raises(InputError, match=r"a\.toml is not TOML"):
        TrainingConfig.read(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_text('model = "tiny"\nscale = 2\n')
    with pytest.raises(InputError, match=r"a\.toml lacks the entry 'steps'"):
        TrainingConfig.read(tmp_path / "a.toml")


@pytest.mark.parametrize(
    ("network", "message"),
    [
        ({"size": "huge"}, "network.size is 'huge', but it must be small or full"),
        ({"wings": 2}, "network.wings is not known: allowed are size, .*channels"),
        ({"channels": "many"}, "network.channels is 'many', but it must be of the kind of 16"),
        ({"channels": 0}, "channels is 0"),
    ],
)
def test_sizes_that_are_refused(network, message):
    with pytest.raises(InputError, match=message):
        trainable("spikesr", 2, network)


def test_sizes_that_other_networks_refuse():
    with pytest.raises(InputError, match="network.size is not known: allowed are blocks, boundaries, channels"):
        trainable("unrolled", 2, {"size": "small"})
    with pytest.raises(InputError, match="folding is 4; it must divide the scale, 2"):
        trainable("unrolled_pase", 2, {"folding": 4})


def test_what_cannot_be_trained(tmp_path):
    with pytest.raises(InputError, match="no network 'resnet'"):
        train(CONFIG.changed(model="resnet"), tmp_path)
    with pytest.raises(InputError, match="nowhere is not a folder"):
        train(CONFIG.changed(pictures="nowhere"), tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file cannot be made"):
        train(CONFIG, tmp_path / "file")
    checkpoint.write(tmp_path / "state", checkpoint.packed({}, jnp.zeros(1)))
    with pytest.raises(InputError, match="state is not the state of a run"):
        train(CONFIG, tmp_path)
    assert os.listdir(tmp_path / "samples") == []


def test_curves_of_losses_below_zero(tmp_path):
    """The logarithm of an error is a loss, too, and has no logarithm."""
    validation.draw_curves(tmp_path / "curves.png", np.linspace(1, -3, 40).astype(np.float32), [], 25.0)
    assert (tmp_path / "curves.png").stat().st_size > 0
