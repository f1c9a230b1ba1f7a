import equinox as eqx
import jax

from benchmarks.ablations import VARIANTS, variant
from learned.networks.spikesr import parameter_count
from learned.training.registry import trainable


def test_each_variant_leaves_out_one_part_and_trains_alike():
    whole, *others = (variant(name, 2, steps=7) for name in VARIANTS)

    def size(config):
        task = trainable(config.model, config.scale, config.network)
        return parameter_count(eqx.filter_eval_shape(task.build, jax.random.key(0)))

    assert len({tuple(sorted(config.network.items())) for config in others}) == len(others) == 4
    for config in others:
        assert config.changed(network=whole.network) == whole
        assert size(config) < size(whole)
