"""The options of `scsr solve` that say how: each becomes an argument of `reconstruct`, or one sentence."""

import os
from typing import get_args

import equinox as eqx
import numpy as np
import pytest

from scsr_opt import priors, solvers
from scsr_opt.camera import Windows
from scsr_opt.cli import solving
from scsr_opt.motion import ILK, TVL1, Dense, Global, PhaseCorrelation, Still
from scsr_opt.operators import Blur, Huber, Welsch

HEIGHT, WIDTH = 24, 40  # of the fixture `spikes`


@pytest.mark.parametrize(
    ("motion", "expected"), [("-0.1,0.25", (-0.1, 0.25)), ("0.5,-1", (0.5, -1)), ("v.npy", (2, 3))]
)
def test_a_motion_that_is_known(scsr, here, file, asked, motion, expected):
    field = np.zeros((2, HEIGHT, WIDTH))
    field[0], field[1] = 2, 3
    np.save(here / "v.npy", field)
    scsr("solve", file, "-o", "a.png", "--motion", motion)
    velocity = asked[0]["motion"].velocity
    assert velocity.shape == (2, HEIGHT, WIDTH) and velocity.dtype == np.float32
    assert velocity[0] == pytest.approx(expected[0]) and velocity[1] == pytest.approx(expected[1])


@pytest.mark.parametrize(
    ("options", "name", "value"),
    [
        ("--motion none", "motion", Still()),
        ("--motion global", "motion", Global()),
        ("--motion dense", "motion", Dense()),
        ("--motion phase", "motion", PhaseCorrelation()),
        ("--motion ilk", "motion", ILK()),
        ("--motion tvl1", "motion", TVL1()),
        ("--refine 2", "refine", 2),
        ("--light key", "light", "key"),
        ("--samples windows:9", "samples", Windows(9)),
        ("--robust huber", "robust", Huber()),
        ("--robust welsch", "robust", Welsch()),
        ("--gain blind", "gain", "blind"),
        ("--optics estimate", "optics", "estimate"),
        ("--prior huber", "prior", priors.HuberTotalVariation()),
        ("--prior tv-anisotropic", "prior", priors.TotalVariation(isotropic=False)),
        ("--prior tv", "prior", priors.TotalVariation()),
        ("--prior tgv", "prior", priors.TotalGeneralizedVariation()),
        ("--prior bilateral", "prior", priors.BilateralTotalVariation()),
        ("--prior wavelet", "prior", priors.WaveletL1()),
        ("--prior nl-means", "prior", priors.PlugAndPlay(priors.nl_means())),
        ("--prior red", "prior", priors.RED(priors.nl_means())),
        ("--bounds non-negative", "prior", priors.Bounded(priors.HuberTotalVariation())),
        ("--bounds -0.1,2", "prior", priors.Bounded(priors.HuberTotalVariation(), -0.1, 2)),
        ("--bounds 0,1 --prior wavelet", "prior", priors.Bounded(priors.WaveletL1(), 0, 1)),
        ("--solver ista", "solver", solvers.ISTA()),
        ("--solver admm", "solver", solvers.ADMM()),
        ("--solver condat-vu", "solver", solvers.CondatVu()),
        ("--solver chambolle-pock", "solver", solvers.ChambollePock()),
        ("--solver nonlinear-cg", "solver", solvers.NonlinearCG()),
        ("--solver lbfgs", "solver", solvers.LBFGS()),
        ("--solver jaxopt-ista", "solver", solvers.JaxoptISTA()),
        ("--solver jaxopt-fista", "solver", solvers.JaxoptFISTA()),
        ("--solver jaxopt-admm", "solver", solvers.JaxoptADMM()),
        ("--solver fista", "solver", solvers.FISTA()),
        ("--solver data-proximal", "solver", solvers.DataProximal()),
        ("--iterations 7", "solver", solvers.FISTA(iterations=7)),
        ("--iterations 7 --solver admm", "solver", solvers.ADMM(iterations=7)),
        ("--strength 0.5", "strength", 0.5),
        ("--strength 0", "strength", 0.0),
    ],
)
def test_choices_are_passed_on(scsr, file, asked, options, name, value):
    scsr("solve", file, "-o", "a.png", *options.split())
    assert type(asked[0][name]) is type(value) and asked[0][name] == value
    assert asked[0].keys() == {"spikes", "scale", "key", name}


def test_the_learned_prior(scsr, file, asked):
    scsr("solve", file, "-o", "a.png", "--prior", "ridge")
    scsr("solve", file, "-o", "b.png", "--scale", "2", "--bounds", "0,1")
    assert isinstance(asked[0]["prior"], priors.RidgeRegulariser)
    assert isinstance(asked[1]["prior"], priors.Bounded) and isinstance(
        asked[1]["prior"].prior, priors.RidgeRegulariser
    )


def test_what_is_said_is_the_default_changes_nothing(scsr, file, asked):
    scsr(
        "solve", file, "-o", "a.png", "--motion", "auto", "--samples", "intervals", "--solver", "auto", "--refine", "0"
    )  # fmt: skip
    assert asked[0].keys() == {"spikes", "scale", "key"}


def test_every_solver_and_prior_by_its_name():
    """None is forgotten when one is added to the packages."""
    methods = sum(
        isinstance(kind, type) and issubclass(kind, solvers.Solver) and kind is not solvers.Solver
        for kind in vars(solvers).values()
    )
    assert len(get_args(solving.Solver)) == methods + 1  # auto
    # Bounds are an option of their own, and a centre is a picture that only a program has at hand.
    unnamed = {priors.Prior, priors.Analysis, priors.Bounded, priors.Centred}
    kinds = {kind for kind in vars(priors).values() if isinstance(kind, type) and issubclass(kind, priors.Prior)}
    assert len(get_args(solving.Prior)) == len(kinds - unnamed) + 1  # total variation has two names


def test_a_lens_is_given_in_sensor_pixels(scsr, file, asked):
    scsr("solve", file, "-o", "a.png", "--scale", "2", "--optics", "0.6")
    assert eqx.tree_equal(asked[0]["optics"], Blur.gaussian((2 * HEIGHT, 2 * WIDTH), 1.2))


def test_gains_are_read_from_a_file(scsr, here, file, asked):
    gain = np.random.default_rng(0).uniform(0.9, 1.1, (HEIGHT, WIDTH))
    np.save(here / "gain.npy", gain)
    scsr("solve", file, "-o", "a.png", "--gain", "gain.npy")
    np.testing.assert_array_equal(asked[0]["gain"], gain)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--iterations 0", "--iterations is 0, but it must be at least 1"),
        ("--strength -1", "--strength is -1.0; it must be a finite number from 0 to 1e+18"),
        ("--strength 1e30", "--strength is 1e+30; it must be a finite number from 0 to 1e+18"),
        ("--strength nan", "--strength is nan"),
        ("--refine -1", "--refine is -1"),
        ("--motion fast", "--motion fast is not known"),
        ("--motion 1,2,3", "--motion 1,2,3 is not known"),
        ("--motion nan,0", "--motion is nan,0, but DOWN,RIGHT must be two finite numbers of sensor pixels per frame"),
        ("--motion 1e39,0", "--motion is 1e39,0, but DOWN,RIGHT must be two finite numbers"),
        ("--motion fast.npy", "finite, in sensor pixels per frame, of 1e+06 at most either way"),
        ("--motion gone.npy", "There is no file gone.npy for --motion"),
        ("--motion small.npy", "but a velocity is (2, 24, 40)"),
        ("--samples windows", "--samples is windows, but it must be intervals or windows:N, N from 1 to 31 frames"),
        ("--samples windows:0", "--samples is windows:0"),
        ("--samples windows:32", "--samples is windows:32"),
        ("--robust cauchy", "--robust"),
        ("--gain 1.1", "--gain is 1.1, but it must be auto, blind, none or the name of a .npy file"),
        ("--gain gone.npy", "There is no file gone.npy for --gain"),
        ("--gain small.npy", "--gain small.npy holds float64 of shape (2, 3), but gains are (24, 40)"),
        ("--gain zeros.npy", "finite and above 0"),
        (
            "--optics wide",
            "--optics is wide, but it must be estimate or a standard deviation from 0 to 40",
        ),
        ("--optics 1e9", "--optics is 1e9, but it must be estimate or a standard deviation from 0 to 40"),
        ("--white-rate 1e-40", "white_rate is 1e-40, but it must be a number from 1e-06 to 1000"),
        ("--white-rate 1e40", "white_rate is 1e+40, but it must be a number from 1e-06 to 1000"),
        ("--readout-rate 1e-320", "readout_rate is 1e-320, but it must be a number from 0.001 to 1e+12"),
        ("--gamma 1e-300", "gamma is 1e-300, but it must be from 0.1 to 10"),
        ("--optics=-1", "--optics is -1"),
        ("--bounds 1,0", "--bounds is 1,0, but it must be LOW,HIGH with LOW below HIGH"),
        ("--bounds 0", "--bounds is 0"),
        ("--bounds 0,1e-300", "upper=1e-300; the lower bound has to be a number below the upper one"),
        ("--prior magic", "--prior"),
        ("--solver magic", "--solver"),
    ],
)
def test_refused_before_it_starts(scsr, here, file, asked, options, message):
    np.save(here / "small.npy", np.zeros((2, 3)))
    np.save(here / "zeros.npy", np.zeros((HEIGHT, WIDTH)))
    np.save(here / "fast.npy", np.full((2, HEIGHT, WIDTH), 1e39))
    assert message in scsr("solve", file, "-o", "a.png", *options.split(), code=2)
    assert asked == [] and sorted(os.listdir(here)) == ["fast.npy", "ramp.npz", "small.npy", "zeros.npy"]


def test_a_solver_that_needs_a_smooth_prior_says_so(scsr, here, file):
    command = ("solve", file, "-o", "a.png", "--scale", "1", "--motion", "none", "--prior", "tv", "--solver", "lbfgs")
    said = scsr(*command, code=2)
    assert "LBFGS was given TotalVariation, which has kinks; it needs a smooth prior" in said
    assert os.listdir(here) == ["ramp.npz"]
