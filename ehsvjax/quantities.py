"""Numbers with their units, as they are read: 59.5 +/- 1.8 µm rather than 5.945e-05 m."""

import math

PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "": 1.0, "m": 1e-3, "µ": 1e-6, "n": 1e-9}
NOT_FINITE = "not finite"
# Nobody reads kiloseconds.
_TAKING = {"s": ("", "m", "µ", "n")} | dict.fromkeys(("m", "m/s", "Pa", "N", "V", "A"), tuple(PREFIXES))


def quantity(value: float, unit: str, error: float = math.nan, digits: int = 3) -> str:
    """Return a value with its unit, in the prefix that reads best, and its standard error where there is one."""
    if not math.isfinite(value):
        return NOT_FINITE
    prefix = prefix_of(abs(value), unit)
    scale = PREFIXES[prefix]
    known = f" +/- {_rounded(error / scale, 2)}" if math.isfinite(error) else ""
    return f"{_rounded(value / scale, digits)}{known} {prefix}{unit}".rstrip()


def prefix_of(largest: float, unit: str) -> str:
    """Return the prefix that leaves a number of at least 1, for units that take one."""
    taken = _TAKING.get(unit, ())
    if not taken or not 0.0 < largest < math.inf:
        return ""
    rounded = float(_rounded(largest, 3))
    return next((prefix for prefix in taken if rounded >= PREFIXES[prefix]), taken[-1])


def _rounded(value: float, digits: int) -> str:
    """Return so many significant digits, 2000 and not 2e+03."""
    return f"{float(f'{value:.{digits}g}'):g}"
