"""Trained networks in files."""

import dataclasses
import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learned.training import checkpoint, registry
from learned.training.checkpoint import Card, grafted, load, save
from learned.training.registry import Trainable
from scsr_opt.errors import InputError


def build(width: int):
    return lambda key: eqx.nn.Conv2d(1, width, 3, key=key)


CARD = Card("tiny", {"scale": 2, "network": {"width": 3}}, "waves", 7, "an abacus", {"psnr": 30.5})


def same(first, second) -> bool:
    a, b = (jax.tree.leaves(eqx.filter(tree, eqx.is_array)) for tree in (first, second))
    return len(a) == len(b) and all(x.dtype == y.dtype and bool((x == y).all()) for x, y in zip(a, b, strict=True))


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    def make(scale, network):
        return Trainable(build(network["width"]), lambda *_: jnp.zeros(()), lambda *_: jnp.zeros((1, 1)))

    monkeypatch.setitem(registry.MODELS, "tiny", make)


@pytest.fixture
def model():
    return build(3)(jax.random.key(1))


@pytest.fixture
def file(tmp_path, model):
    save(tmp_path / "a.scsr", model, CARD)
    return tmp_path / "a.scsr"


def test_comes_back_as_it_was(file, model):
    loaded, card = load(file)
    assert same(loaded, model) and card == CARD
    assert same(load(file, like=build(3)(jax.random.key(9)))[0], model)
    assert load(file, configuration={"network": {"width": 3}, "scale": 2})[1] == CARD


def test_half_precision(tmp_path, file, model):
    half = tmp_path / "half.scsr"
    save(half, model, dataclasses.replace(CARD, precision="float16"))
    loaded, card = load(half)
    assert card.precision == "float16" and loaded.weight.dtype == jnp.float32
    # Eleven significant bits: rounding is off by 2^-11 of the value at most.
    assert np.asarray(loaded.weight) == pytest.approx(np.asarray(model.weight), rel=2.0**-11)
    assert not same(loaded, model)
    assert half.stat().st_size < file.stat().st_size


@pytest.mark.parametrize("place", [0.03, 0.3, 0.7, 0.99])
def test_damage_is_noticed(file, place):
    content = bytearray(file.read_bytes())
    content[int(place * len(content))] ^= 1
    file.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"a\.scsr .*(is damaged|not a checkpoint|has format)"):
        load(file)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_a_cut_is_noticed(file, share):
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match="damaged or cut short|not a checkpoint"):
        load(file)


def test_other_configurations_are_refused(file):
    with pytest.raises(InputError, match=r"another configuration: scale is 2 there, but 4 is wanted"):
        load(file, configuration={"scale": 4, "network": {"width": 3}})
    with pytest.raises(InputError, match="weights of other shapes"):
        load(file, like=build(4)(jax.random.key(0)))
    two = (build(3)(jax.random.key(0)), jnp.zeros(3))
    with pytest.raises(InputError, match="weights of other shapes"):
        load(file, like=two)
    with pytest.raises(InputError, match="weights of other shapes"):  # fewer arrays than the file holds
        load(file, like=eqx.tree_at(lambda m: m.bias, two[0], None))


def test_other_files_are_refused(tmp_path, monkeypatch, model, file):
    with pytest.raises(InputError, match=r"b\.scsr cannot be read: no such file"):
        load(tmp_path / "b.scsr")
    state = tmp_path / "state"
    checkpoint.write(state, checkpoint.packed({"run": {}}, model))
    with pytest.raises(InputError, match="state is not the checkpoint of a network"):
        load(state)
    save(file, model, dataclasses.replace(CARD, model="unheard-of"))
    with pytest.raises(InputError, match="no network 'unheard-of': model must be one of .*spikesr.*tiny"):
        load(file)
    monkeypatch.setattr(checkpoint, "FORMAT", 2)
    with pytest.raises(InputError, match="has format 1, but this version reads format 2"):
        load(file)


def test_bad_cards_and_too_large_networks(tmp_path, model):
    with pytest.raises(InputError, match="precision is 'float8'"):
        dataclasses.replace(CARD, precision="float8")
    with pytest.raises(InputError, match=r"would take 24\.\d MB, but 20 MB are allowed"):
        save(tmp_path / "large.scsr", jnp.zeros(6_000_000), CARD)
    assert not os.listdir(tmp_path)


def test_a_write_that_fails_leaves_the_old_file(file, model, monkeypatch):
    before = file.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=f"Cannot write {file}: no space left on device"):
        save(file, model, dataclasses.replace(CARD, steps=8))
    assert file.read_bytes() == before and os.listdir(file.parent) == ["a.scsr"]


class _Whole(eqx.Module):
    part: eqx.nn.Conv2d
    rest: eqx.nn.Conv2d


class _Part(eqx.Module):
    part: eqx.nn.Conv2d


def test_a_part_takes_its_place_in_a_network(tmp_path, monkeypatch):
    made = [build(3)(jax.random.key(n)) for n in range(3)]
    monkeypatch.setitem(
        registry.MODELS,
        "part",
        lambda *_: Trainable(lambda key: _Part(build(3)(key)), lambda *_: jnp.zeros(()), lambda *_: jnp.zeros((1, 1))),
    )
    save(tmp_path / "part.scsr", _Part(made[0]), dataclasses.replace(CARD, model="part"))
    found, card = grafted(_Whole(made[1], made[2]), str(tmp_path / "part.scsr"))
    assert same(found, _Whole(made[0], made[2])) and card.steps == CARD.steps
    with pytest.raises(InputError, match=r"has weights \.part\.weight of shape .* has nothing: start from a file"):
        grafted(made[1], str(tmp_path / "part.scsr"))
    with pytest.raises(InputError, match=r"has of shape \(4, 1, 3, 3\): start from a file"):
        grafted(_Part(build(4)(jax.random.key(0))), str(tmp_path / "part.scsr"))
    with pytest.raises(InputError, match="none.scsr cannot be read"):
        grafted(made[1], str(tmp_path / "none.scsr"))


def test_a_part_is_taken_from_a_network(tmp_path, monkeypatch):
    made = [build(3)(jax.random.key(n)) for n in range(3)]
    monkeypatch.setitem(
        registry.MODELS,
        "whole",
        lambda *_: Trainable(
            lambda key: _Whole(build(3)(key), build(3)(key)), lambda *_: jnp.zeros(()), lambda *_: jnp.zeros((1, 1))
        ),
    )
    save(tmp_path / "whole.scsr", _Whole(made[0], made[1]), dataclasses.replace(CARD, model="whole"))
    assert same(grafted(_Part(made[2]), str(tmp_path / "whole.scsr"))[0], _Part(made[0]))
    other = _Whole(made[2], build(4)(jax.random.key(3)))  # the rest is of another size
    found, card = grafted(other, f"{tmp_path / 'whole.scsr'}:part")
    assert same(found, _Whole(made[0], other.rest)) and card.model == "whole"
    with pytest.raises(InputError, match="whole.scsr has no weights of a part 'none'"):
        grafted(other, f"{tmp_path / 'whole.scsr'}:none")
    with pytest.raises(InputError, match=r"has weights \.rest\.weight of shape .* has of shape"):
        grafted(other, str(tmp_path / "whole.scsr"))


def test_of_two_configurations_the_model_is_compared_first():
    with pytest.raises(InputError, match="run was made with another configuration: model is 'a' there, but 'b'"):
        checkpoint.check_same("run", {"model": "a", "batch": 2}, {"model": "b", "batch": 3})
