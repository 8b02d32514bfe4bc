"""Functions of one instant of a motion, with exact first and second derivatives, evaluated at many instants at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from factorgrasp.typing import FloatArray


class NodeFunction:
    """An expression ``s(z, p)`` of a motion's values z at an instant and of given numbers p there.

    Parameters
    ----------
    name : str
    z, p, out : casadi.SX
        Column vectors.
    """

    def __init__(self, name: str, z: Any, p: Any, out: Any) -> None:

        self.size_in, self.size_p, self.size_out = int(z.numel()), int(p.numel()), int(out.numel())
        self._name, self._z, self._p, self._out = name, z, p, out
        self._functions: dict[str, Any] = {}
        self._maps: dict[tuple[str, int], Any] = {}

    def _function(self, kind: str) -> Any:
        """Made when it is first asked for: second derivatives of a robot take their time."""
        import casadi as ca

        if kind not in self._functions:
            inputs, out = [self._z, self._p], self._out
            if kind == "jacobian":
                out = ca.jacobian(out, self._z)
            elif kind == "hessian":
                load = ca.SX.sym("load", self.size_out)
                inputs, out = [*inputs, load], ca.hessian(ca.dot(load, out), self._z)[0]
            self._functions[kind] = ca.Function(f"{self._name}_{kind}", inputs, [ca.densify(out)])
        return self._functions[kind]

    def _run(self, kind: str, count: int, *arguments: FloatArray) -> FloatArray:
        if (kind, count) not in self._maps:
            self._maps[kind, count] = self._function(kind).map(count)
        return np.asarray(self._maps[kind, count](*arguments).full())

    def values(self, z: FloatArray, p: FloatArray) -> FloatArray:
        """(n, out) for z (in, n) and p (p, n)."""
        return self._run("value", z.shape[1], z, p).T if z.shape[1] else np.empty((0, self.size_out))

    def jacobians(self, z: FloatArray, p: FloatArray) -> FloatArray:
        """(n, out, in)."""
        count = z.shape[1]
        if not count:
            return np.empty((0, self.size_out, self.size_in))
        flat = self._run("jacobian", count, z, p)
        return flat.reshape(self.size_out, count, self.size_in).transpose(1, 0, 2)

    def hessians(self, z: FloatArray, p: FloatArray, load: FloatArray) -> FloatArray:
        """(n, in, in), of ``load' s`` for load (out, n)."""
        count = z.shape[1]
        if not count:
            return np.empty((0, self.size_in, self.size_in))
        flat = self._run("hessian", count, z, p, load)
        return flat.reshape(self.size_in, count, self.size_in).transpose(1, 0, 2)
