"""Sliders over the parameters of a picture, with stills for readers who have no kernel to slide them with."""

from collections.abc import Callable, Sequence
from typing import Any

import matplotlib
import numpy as np

from scsr_opt.errors import InputError
from scsr_opt.report.charts import _page
from scsr_opt.report.figures import _STYLE, _picture, _white_level
from scsr_opt.report.shown import ShownFigure

_EACH = 1.9  # inches of a still


def explore(picture: Callable[..., Any], *, title: str | None = None, **values: Sequence[Any]) -> ShownFigure:
    """Stills of how a picture depends on its parameters, a row a parameter; in a notebook with ipywidgets also sliders.

        explore(lambda strength, key: solve(strength, key), strength=[0.001, 0.002, 0.004], key=[10, 20, 30])

    Along a row one parameter takes all of its values, and the others their middle ones. Without ipywidgets
    (`pip install ipywidgets`) there are the stills alone, which also stay in a notebook that is saved.

    **Arguments:**
    - `picture`: makes the picture (H, W), intensity, of one value of each parameter, given by name. It is called once
      for each still, and each time a slider moves.
    - `values`: name → values of a parameter, at least one.

    **Returns:** a figure of the stills, with one grey scale.
    """
    for name, allowed in values.items():
        if not len(allowed):
            raise InputError(f"There is no value to choose for {name}: give at least one.")
    if not values:
        raise InputError("There is nothing to explore: name a parameter, as in explore(picture, strength=[0.01, 0.1]).")
    middle = {name: allowed[len(allowed) // 2] for name, allowed in values.items()}
    stills = [
        [(f"{name} = {value:g}", np.asarray(picture(**{**middle, name: value}))) for value in allowed]
        for name, allowed in values.items()
    ]
    white = _white_level([image for row in stills for _, image in row])
    across = max(len(row) for row in stills)
    tall, wide = stills[0][0][1].shape
    with matplotlib.rc_context(_STYLE):
        size = (across * _EACH, len(stills) * (_EACH * tall / wide + 0.25))
        drawn, grid = _page(size, title, rows=len(stills), columns=across)
        for axes in np.ravel(grid):
            axes.set_axis_off()
        for axes_of_row, row in zip(np.reshape(grid, (len(stills), across)), stills, strict=True):
            for axes, (name, image) in zip(axes_of_row, row, strict=False):
                _picture(axes, image, white)
                axes.set_aspect("equal")
                axes.set_title(name, loc="left", fontsize=8.5)
    _sliders(picture, values, middle, white)
    return drawn


def _sliders(
    picture: Callable[..., Any], values: dict[str, Sequence[Any]], middle: dict[str, Any], white: float
) -> None:
    """Shows sliders and the picture that they choose; nothing where ipywidgets is not installed."""
    try:
        import ipywidgets  # pyright: ignore[reportMissingImports]  (the extra `sliders`)
        from IPython.display import display
    except ImportError:
        return
    import io

    from PIL import Image

    from scsr_opt.report.pictures import quantise

    shown = ipywidgets.Image(format="png", width=480)
    sliders = {
        name: ipywidgets.SelectionSlider(options=list(allowed), value=middle[name], description=name)
        for name, allowed in values.items()
    }

    def draw(_: Any = None) -> None:
        image = np.asarray(picture(**{name: slider.value for name, slider in sliders.items()}))
        stream = io.BytesIO()
        Image.fromarray(quantise(np.clip(image / white, 0, 1))).save(stream, "PNG")
        shown.value = stream.getvalue()

    for slider in sliders.values():
        slider.observe(draw, "value")
    draw()
    display(ipywidgets.VBox([*sliders.values(), shown]))
