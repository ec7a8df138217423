"""How figures look: size, fonts, and two sets of colors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import matplotlib as mpl
import seaborn as sns
from matplotlib import font_manager

from acmr.cells import CELLS

FONT = "DejaVu Sans"
#: Width of a column of a two-column paper, inches.
COLUMN = 3.4

_NAMES = ("blue", "orange", "green", "red", "purple", "brown", "cyan", "pink", "olive", "gray")
_TAB = {name: f"tab:{name}" for name in _NAMES}
#: Okabe and Ito's colors, which stay apart for people with color vision deficiency, and three of Tol's beside them.
_SAFE = {
    "blue": "#0072B2",
    "orange": "#E69F00",
    "green": "#009E73",
    "red": "#D55E00",
    "purple": "#CC79A7",
    "brown": "#56B4E9",
    "cyan": "#4D4D4D",
    "pink": "#882255",
    "olive": "#999933",
    "gray": "#BBBBBB",
}
_OTHER_MARKERS = "<>ph*d8H"


@dataclass(frozen=True)
class Palette:
    """Colors and markers of the groups.

    Attributes:
        name: ``paper`` or ``colorblind``.
        markers: Whether curves carry markers, so that they can be told apart without color.
    """

    name: str
    markers: bool

    def color(self, group: str, groups: Sequence[str]) -> Any:
        """Color of a group, the same in all figures.

        Args:
            group: Its name.
            groups: All groups, so that those that are no cells get colors of their own.
        """
        if group in CELLS:
            name = CELLS[group].color
            return (_SAFE if self.markers else _TAB).get(name, name)
        others = [other for other in groups if other not in CELLS]
        return sns.husl_palette(len(others), l=0.5)[others.index(group)]

    def marker(self, group: str, groups: Sequence[str]) -> str:
        """Marker of a group."""
        if group in CELLS:
            return CELLS[group].marker
        others = [other for other in groups if other not in CELLS]
        return _OTHER_MARKERS[others.index(group) % len(_OTHER_MARKERS)]


PALETTES = (Palette("paper", markers=False), Palette("colorblind", markers=True))


@cache
def letters() -> frozenset[int]:
    """Numbers of the letters that the figures' font has."""
    return frozenset(font_manager.get_font(font_manager.findfont(FONT)).get_charmap())


def apply() -> None:
    """Sets fonts and lines for a column of a paper; fonts are embedded in PDF (type 42) and drawn as paths in SVG."""
    mpl.use("Agg")
    sns.set_theme(
        context="paper",
        style="ticks",
        rc={
            "font.family": FONT,
            "font.size": 7,
            "axes.labelsize": 7,
            "axes.titlesize": 7.5,
            "legend.fontsize": 6.5,
            "legend.title_fontsize": 6.5,
            "xtick.labelsize": 6.5,
            "ytick.labelsize": 6.5,
            "axes.linewidth": 0.6,
            "xtick.major.width": 0.6,
            "ytick.major.width": 0.6,
            "xtick.major.size": 2.5,
            "ytick.major.size": 2.5,
            "lines.linewidth": 1.2,
            "axes.grid": True,
            "grid.linewidth": 0.4,
            "grid.color": "0.9",
            "axes.axisbelow": True,
            "legend.frameon": False,
            "figure.dpi": 100,
            "savefig.dpi": 300,
            "pdf.fonttype": 42,
            "ps.fonttype": 42,
            "svg.fonttype": "path",
            "svg.hashsalt": "acmr",
            # Names hold dollar signs.
            "text.parse_math": False,
        },
    )
