"""Cost of a function: seconds on this machine, and floating-point operations as XLA counts them."""

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
from jax.extend.core import jaxpr_as_fun


class Cost(NamedTuple):
    """**Fields:** `seconds` of one call, compiled before; `flops`, None where XLA does not count them."""

    seconds: float
    flops: float | None


def cost(
    function: Callable[..., Any], *arguments: Any, options: Mapping[str, bool | str] | None = None, runs: int = 3
) -> Cost:
    """The cost of `function(*arguments)`, compiled with these options; arrays among the arguments are what it is a
    function of. The quickest of `runs` after the first counts: what disturbs a run only makes it slower.

    FLOPs are those of XLA's cost analysis of the compiled function. It counts the body of a loop once; the rounds of a
    `scan` (and of a `fori_loop` with a known number) are added here, those of a `while_loop` are unknown.
    """
    arrays, rest = eqx.partition(arguments, eqx.is_array)

    def pure(arrays: Any) -> list[jax.Array]:
        return jax.tree.leaves(eqx.filter(function(*eqx.combine(arrays, rest)), eqx.is_array))

    compiled = jax.jit(pure).lower(arrays).compile(compiler_options=None if options is None else dict(options))
    jax.block_until_ready(compiled(arrays))
    seconds = []
    for _ in range(runs):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(arrays))
        seconds.append(time.perf_counter() - begin)
    once, rounds = _counted(compiled), _in_rounds(jax.make_jaxpr(pure)(arrays).jaxpr)
    return Cost(min(seconds), None if once is None or rounds is None else once + rounds)


def _counted(compiled: Any) -> float | None:
    found = compiled.cost_analysis()
    flops = (found or {}).get("flops", -1.0)
    return float(flops) if flops >= 0 else None


def _in_rounds(program: Any) -> float | None:
    """FLOPs of all rounds of scans but the ones that XLA counts; None if there is a loop without a known end."""
    total = 0.0
    for equation in program.eqns:
        if equation.primitive.name == "while":
            return None
        if equation.primitive.name == "scan":
            body = equation.params["jaxpr"]
            once, inner = _flops_of(body), _in_rounds(body.jaxpr)
            if once is None or inner is None:
                return None
            length, written_out = equation.params["length"], equation.params["unroll"]
            # XLA sees the body once, or as often as it is written out, and the scans in it likewise.
            total += once * max(length - written_out, 0) + inner * length
            continue
        for value in equation.params.values():
            for part in value if isinstance(value, tuple | list) else (value,):
                inside = getattr(part, "jaxpr", part)
                if hasattr(inside, "eqns"):
                    more = _in_rounds(inside)
                    if more is None:
                        return None
                    total += more
    return total


def _flops_of(body: Any) -> float | None:
    shapes = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in body.jaxpr.invars]
    return _counted(jax.jit(jaxpr_as_fun(body)).lower(*shapes).compile())
