"""`ShownFigure`: a figure that a notebook shows without any set-up."""

import io

from matplotlib.figure import Figure


class ShownFigure(Figure):
    """A matplotlib figure that a notebook shows as the last line of a cell.

    Figures are shown by themselves only after `%matplotlib inline`, or after `matplotlib.pyplot` has drawn something.
    Figures of this package are made without pyplot, which keeps every figure until it is closed.
    """

    def _repr_png_(self) -> bytes:
        """The figure as a PNG, for IPython."""
        picture = io.BytesIO()
        self.savefig(picture, format="png")
        return picture.getvalue()
