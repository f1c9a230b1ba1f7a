"""Pictures that no photograph is like: letters, flat shapes, patterns, plain surfaces.

A network that has seen photographs alone takes the edge of a letter for soft, and finds texture on a plain wall. This
module does not import JAX, as `learned.training.data` does not.
"""

import string

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

# Drawn so many times as large and averaged: edges between pixels are grey.
_FINER = 3
_LETTERS = np.array(list(string.ascii_letters + string.digits + "      .,:-+"))


def drawing(rng: np.random.Generator, side: int) -> Float[np.ndarray, "side side"]:
    """A square drawing, intensity, of a kind and sizes drawn by chance."""
    kind = rng.choice(["letters", "shapes", "checkerboard", "grating", "plain"], p=[0.3, 0.35, 0.1, 0.15, 0.1])
    low, high = rng.uniform(0, 1, 2)
    match kind:
        case "letters":
            return _letters(rng, side, low, high)
        case "shapes":
            return _shapes(rng, side)
        case "checkerboard":
            length = rng.integers(1, 17, 2)
            row, column = (np.arange(side) // n for n in length)
            return np.where((row[:, None] + column) % 2, low, high).astype(np.float32)
        case "grating":
            period, angle = np.exp(rng.uniform(np.log(2.5), np.log(24))), rng.uniform(0, np.pi)
            row, column = np.mgrid[:side, :side]
            wave = np.sin(2 * np.pi * (row * np.sin(angle) + column * np.cos(angle)) / period)
            return ((low + high) / 2 + (high - low) / 2 * wave).astype(np.float32)
    slope = rng.uniform(-0.3, 0.3, 2) * rng.integers(2)
    along = np.linspace(-0.5, 0.5, side)
    return np.clip(low + slope[0] * along[:, None] + slope[1] * along, 0, 1).astype(np.float32)


def _letters(rng: np.random.Generator, side: int, low: float, high: float) -> Float[np.ndarray, "side side"]:
    sheet = Image.new("L", (_FINER * side, _FINER * side), round(255 * low))
    pen, height = ImageDraw.Draw(sheet), 0.0
    while height < sheet.height:
        size = float(_FINER * rng.uniform(7, 40))
        words = "".join(rng.choice(_LETTERS, 2 + int(3 * sheet.width / size)))
        pen.text((rng.uniform(-size, 0), height), words, fill=round(255 * high), font=ImageFont.load_default(size))
        height += size * rng.uniform(1.0, 1.6)
    return _averaged(sheet)


def _shapes(rng: np.random.Generator, side: int) -> Float[np.ndarray, "side side"]:
    """Flat shapes, each on those before it, from large to small."""
    sheet = Image.new("L", (_FINER * side, _FINER * side), int(rng.integers(256)))
    pen, length = ImageDraw.Draw(sheet), sheet.width
    for size in np.sort(np.exp(rng.uniform(np.log(0.02), np.log(0.8), int(rng.integers(3, 60)))))[::-1]:
        middle, grey = rng.uniform(0, length, 2), int(rng.integers(256))
        turn = rng.uniform(0, 2 * np.pi)
        match int(rng.integers(3)):
            case 0:
                half = size * length / 2 * rng.uniform(0.3, 1, 2)
                pen.ellipse([*(middle - half), *(middle + half)], fill=grey)
            case 1:
                angles = turn + 2 * np.pi * np.arange(corners := int(rng.integers(3, 6))) / corners
                around = middle + size * length / 2 * np.stack([np.cos(angles), np.sin(angles)], 1)
                pen.polygon([(float(x), float(y)) for x, y in around], fill=grey)
            case _:
                end = middle + size * length * np.array([np.cos(turn), np.sin(turn)])
                pen.line([*middle, *end], fill=grey, width=int(_FINER * rng.uniform(0.7, 4)))
    return _averaged(sheet)


def _averaged(sheet: Image.Image) -> Float[np.ndarray, "side side"]:
    fine = np.asarray(sheet, np.float32) / 255
    side = fine.shape[0] // _FINER
    return fine.reshape(side, _FINER, side, _FINER).mean((1, 3))
