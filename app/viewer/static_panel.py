"""The panel beside the scene of a static page, as plain HTML: layers to choose, their legends, a table, facts.

It reads without JavaScript: |B|'s legend, the table and the facts are there; `assets/static/panel.js` makes the rest
live.
"""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from app.geometry import Array
from app.viewer.layers import LAYERS, ColourScale

__all__ = ["legend", "panel_html", "radio_label", "table"]

_GROUPS = {
    "Field": ("norm", "bx", "by", "bz", "horizontal", "vertical", "inclination"),
    "Confidence": ("sd", "coverage", "conflict", "measured"),
    "Telling places apart": ("gradient", "gradient_x", "gradient_y", "information", "expected_error"),
}
_SHORT = {
    "gradient": "Gradient",
    "gradient_x": "Gradient along x",
    "gradient_y": "Gradient along y",
    "expected_error": "Expected error",
}
_EXTRAS = {"arrows": "Field arrows", "walks": "Survey walks", "outline": "Floor outline"}


def panel_html(
    title: str,
    layers: Mapping[str, Array],
    scales: Mapping[str, ColourScale],
    heights_m: Sequence[float],
    extras: Sequence[str],
    shown: frozenset[str],
    facts: Mapping[str, str],
    height_index: int,
) -> str:
    """The panel. `layers`: values (nz, ny, nx) by name; `extras`: what can be switched, of which `shown` is."""
    legends = "".join(legend(layer, scale, hidden=layer != "norm") for layer, scale in scales.items())
    told = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(fact)}</dd></div>" for name, fact in facts.items())
    return f"""
<aside id="isodyn-panel" aria-label="Map">
<header><h1>{escape(title)}</h1>
<button type="button" id="isodyn-collapse" aria-expanded="true" aria-controls="isodyn-body">Hide panel</button></header>
<div id="isodyn-legends" aria-live="polite">{legends}</div>
<div id="isodyn-body">
<p id="isodyn-note" role="status" hidden>Layers cannot be switched here: they are in the scene tree, which the button at
the top right of the picture opens.</p>
<fieldset id="isodyn-controls" disabled><legend class="isodyn-unseen">What is shown</legend>
{_height_select(heights_m, height_index)}
<fieldset class="isodyn-layers"><legend>Layer</legend>{_radios(list(layers))}</fieldset>
<fieldset class="isodyn-row"><legend>Also show</legend>{_checkboxes(extras, shown)}</fieldset>
<fieldset class="isodyn-row"><legend>View</legend><button type="button" data-view="oblique">Oblique</button>
<button type="button" data-view="above">From above</button></fieldset>
{_point_inputs()}
</fieldset>
<dl>{told}</dl>
<details><summary>Layers as numbers</summary>{table(layers, scales, heights_m, height_index)}</details>
<p class="isodyn-help">Drag to turn, drag with the right button or two fingers to move, wheel or pinch to zoom.
Arrow keys turn and W, A, S, D, Q, E move. Point at the map, or tap it, to read the field.</p>
</div></aside>
<div id="isodyn-readout" hidden></div>"""


def radio_label(layer: str) -> str:
    """A layer's name without what its legend explains in brackets."""
    about = LAYERS[layer]
    return _SHORT.get(layer) or about.short or about.title.split(" (")[0]


def _radios(layers: Sequence[str]) -> str:
    groups = {name: [layer for layer in layers if layer in members] for name, members in _GROUPS.items()}
    known = {layer for members in _GROUPS.values() for layer in members}
    groups["Other"] = [layer for layer in layers if layer not in known]
    return "".join(
        f'<div role="group" aria-label="{name}"><p>{name}</p>{"".join(map(_radio, members))}</div>'
        for name, members in groups.items()
        if members
    )


def _radio(layer: str) -> str:
    checked = " checked" if layer == "norm" else ""
    return (
        f'<label title="{escape(LAYERS[layer].title)}">'
        f'<input type="radio" name="isodyn-layer" value="{layer}"{checked} />{escape(radio_label(layer))}</label>'
    )


def _checkboxes(extras: Sequence[str], shown: frozenset[str]) -> str:
    return "".join(
        f'<label><input type="checkbox" value="{name}"{" checked" * (name in shown)} />{_EXTRAS[name]}</label>'
        for name in extras
    )


def _height_select(heights_m: Sequence[float], height_index: int) -> str:
    if len(heights_m) == 1:
        return ""
    options = "".join(
        f'<option value="{k}"{" selected" * (k == height_index)}>{z:.2f} m</option>' for k, z in enumerate(heights_m)
    )
    return f'<label class="isodyn-height">Height <select id="isodyn-height">{options}</select></label>'


def _point_inputs() -> str:
    return (
        '<fieldset class="isodyn-point"><legend>Field at a point</legend>'
        '<label>x <input type="number" id="isodyn-x" step="0.5" /> m</label>'
        '<label>y <input type="number" id="isodyn-y" step="0.5" /> m</label>'
        '<output id="isodyn-value" for="isodyn-x isodyn-y">Give x and y, or point at the map.</output></fieldset>'
    )


def legend(layer: str, scale: ColourScale, hidden: bool = False) -> str:
    """Title with unit, colour bar and round numbers at their places along it."""
    about = LAYERS[layer]
    name = f"{about.title}, {about.unit}" if about.unit else about.title
    ticks = _ticks(layer, scale)
    words = " and ".join(label for _, label in ticks) if layer == "measured" else f"{ticks[0][1]} to {ticks[-1][1]}"
    marks = "".join(f'<span style="left:{100 * at:.1f}%">{label}</span>' for at, label in ticks)
    return (
        f'<div class="isodyn-legend" data-layer="{layer}" role="img" aria-label="{escape(name)}: {words}"'
        f'{" hidden" * hidden}><p>{escape(name)}</p><div class="isodyn-bar" style="background:{_bar(layer, scale)}">'
        f'</div><div class="isodyn-ticks">{marks}</div></div>'
    )


def _bar(layer: str, scale: ColourScale) -> str:
    stops = [f"rgb({r},{g},{b})" for r, g, b in scale.rgb(np.linspace(scale.low, scale.high, 24))]
    if layer == "measured":
        return f"linear-gradient(to right,{stops[0]} 50%,{stops[-1]} 50%)"
    return f"linear-gradient(to right,{','.join(stops)})"


def _ticks(layer: str, scale: ColourScale) -> list[tuple[float, str]]:
    """Places along the bar, 0 to 1, and what is written there."""
    from matplotlib.ticker import MaxNLocator

    if layer == "measured":
        return [(0.25, "not measured"), (0.75, "measured")]
    locator = MaxNLocator(8, steps=[1, 2, 2.5, 5, 10], integer=layer == "coverage")
    values = [v for v in locator.tick_values(scale.low, scale.high) if scale.low - 1e-9 <= v <= scale.high + 1e-9]
    step = float(values[1] - values[0]) if len(values) > 1 else 1.0
    decimals = next((d for d in range(6) if abs(round(step, d) - step) < 1e-9 * step), 6)
    return [((float(v) - scale.low) / (scale.high - scale.low), _number(v, decimals)) for v in values]


def table(
    layers: Mapping[str, Array], scales: Mapping[str, ColourScale], heights_m: Sequence[float], height_index: int
) -> str:
    """Median and the middle nine tenths of every layer, a body of rows per height, of which one is not hidden."""
    head = "".join(f'<th scope="col">{name}</th>' for name in ("Layer", "Median", "5 %", "95 %", "Unit"))
    bodies = ""
    for k in range(len(heights_m)):
        rows = "".join(_row(layer, values[k], scales[layer]) for layer, values in layers.items() if layer != "measured")
        bodies += f'<tbody data-height="{k}"{" hidden" * (k != height_index)}>{rows}</tbody>'
    return f"<table><thead><tr>{head}</tr></thead>{bodies}</table>"


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}".replace("-", "−")


def _row(layer: str, values: Array, scale: ColourScale) -> str:
    known = values[np.isfinite(values)]
    decimals = 0 if layer == "coverage" else int(np.clip(2 - np.floor(np.log10(scale.high - scale.low)), 0, 3))
    numbers = [_number(q, decimals) for q in np.percentile(known, [50, 5, 95])] if len(known) else ["–"] * 3
    cells = "".join(f"<td>{number}</td>" for number in numbers)
    return f'<tr><th scope="row">{escape(radio_label(layer))}</th>{cells}<td>{escape(LAYERS[layer].unit)}</td></tr>'
