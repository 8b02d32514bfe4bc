"""Functions of one coordinate in OpenSim models: how far a joint turns or slides along an axis."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

Function = Callable[[FloatArray], FloatArray]


def read_function(element: ElementTree.Element, field: str) -> Function:
    """The function that an element describes, of values of its coordinate.

    Raises
    ------
    InputError
        For a kind that is not known; it names the field.
    """
    kind = element.tag
    if kind == "MultiplierFunction":
        scale = _numbers(element, "scale", field)[0]
        inner = read_function(inner_function(element, field), field)
        return lambda x: scale * inner(x)
    if kind == "Constant":
        value = _numbers(element, "value", field)[0]
        return lambda x: np.full(x.shape, value)
    if kind in ("LinearFunction", "PolynomialFunction"):
        coefficients = np.array(_numbers(element, "coefficients", field))
        return lambda x: np.asarray(np.polyval(coefficients, x))
    if kind in ("SimmSpline", "NaturalCubicSpline", "PiecewiseLinearFunction", "GCVSpline"):
        x, y = (np.array(_numbers(element, key, field)) for key in "xy")
        if x.size != y.size or x.size < 2 or (np.diff(x) <= 0.0).any():
            raise InputError(field, "increasing x and as many y", f"{x.size} and {y.size} of them")
        if kind == "PiecewiseLinearFunction" or x.size == 2:
            return _linear(x, y)
        if kind == "SimmSpline":
            return simm_spline(x, y)
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(x, y, bc_type="natural")
        return lambda at: np.asarray(spline(at))
    raise InputError(field, "a function that is constant, linear, a polynomial or a spline", kind)


def inner_function(element: ElementTree.Element, field: str) -> ElementTree.Element:
    """The function inside an element ``function``, or the element that is named so."""
    holder = element.find("function")
    if holder is not None and len(holder):
        return holder[0]
    for child in element:
        if child.get("name") == "function":
            return child
    raise InputError(field, "a function", "none")


def simm_spline(x: FloatArray, y: FloatArray) -> Function:
    """Cubic spline whose third derivatives at both ends are those of the cubics through the outer four points.

    Forsythe, Malcolm and Moler (1977), Computer Methods for Mathematical Computations, chapter 4; beyond its ends it goes on straight.
    """
    n = x.size
    if n == 3:
        from scipy.interpolate import CubicSpline

        return _straight_beyond(CubicSpline(x, y, bc_type="natural"), x)
    h, slope = np.diff(x), np.diff(y) / np.diff(x)
    second = np.diff(slope)
    A, b = np.zeros((n, n)), np.zeros(n)
    for i in range(1, n - 1):
        A[i, i - 1 : i + 2] = h[i - 1], 2.0 * (h[i - 1] + h[i]), h[i]
        b[i] = second[i - 1]
    first = second / (x[2:] - x[:-2])
    A[0, :2], A[-1, -2:] = (-h[0], h[0]), (h[-1], -h[-1])
    b[0] = (first[1] - first[0]) * h[0] ** 2 / (x[3] - x[0])
    b[-1] = -(first[-1] - first[-2]) * h[-1] ** 2 / (x[-1] - x[-4])
    s = np.linalg.solve(A, b)
    from scipy.interpolate import PPoly

    pieces = np.array([np.diff(s) / h, 3.0 * s[:-1], slope - h * (s[1:] + 2.0 * s[:-1]), y[:-1]])
    return _straight_beyond(PPoly(pieces, x), x)


def _straight_beyond(spline: Callable[..., FloatArray], x: FloatArray) -> Function:
    ends = np.array([x[0], x[-1]])
    value, slope = np.asarray(spline(ends)), np.asarray(spline(ends, 1))

    def function(at: FloatArray) -> FloatArray:
        inside = np.asarray(spline(np.clip(at, x[0], x[-1])))
        below, above = at < x[0], at > x[-1]
        out = np.where(below, value[0] + slope[0] * (at - x[0]), inside)
        return np.asarray(np.where(above, value[1] + slope[1] * (at - x[-1]), out))

    return function


def _linear(x: FloatArray, y: FloatArray) -> Function:
    def function(at: FloatArray) -> FloatArray:
        k = np.clip(np.searchsorted(x, at) - 1, 0, x.size - 2)
        return np.asarray(y[k] + (at - x[k]) * (y[k + 1] - y[k]) / (x[k + 1] - x[k]))

    return function


def _numbers(element: ElementTree.Element, key: str, field: str) -> list[float]:
    text = element.findtext(key) or ""
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if not values:
        raise InputError(f"{field}, {key}", "numbers", repr(text.strip()[:40]))
    return values
