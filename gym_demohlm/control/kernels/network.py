"""``WholeBodyController._act``: what lies between the products of the policy's layers, for robots and their mirror."""

import numpy as np

from gym_demohlm.arithmetic import elu_of_number
from gym_demohlm.control.kernels.compiler import compiled, inlined

_elu = inlined(elu_of_number)


@inlined
def _steps(x, row_step, bound):
    """``arithmetic.ExactProduct``: a number in whole steps of a product's grid."""
    most = bound / row_step
    return np.rint(min(max(x * (1.0 / row_step), -most), most))


@compiled
def enter(observed, mean, scale, source, sign, row_step, bound, out):
    """Write what the first product takes.

    Args:
        observed: (n, inputs or more).
        mean: (inputs,) of the normaliser.
        scale: (inputs,) its inverse deviation.
        source: (inputs,) which input each one is in the mirror.
        sign: (inputs,) and its sign there.
        row_step: Of the product.
        bound: Of the product.
        out: (2 n, inputs) written: the robots, then their mirror, in whole steps.
    """
    n = len(observed)
    for row in range(n):
        for column in range(len(mean)):
            out[row, column] = (observed[row, column] - mean[column]) * scale[column]
        for column in range(len(mean)):
            out[n + row, column] = _steps(out[row, source[column]] * sign[column], row_step, bound)
        for column in range(len(mean)):
            out[row, column] = _steps(out[row, column], row_step, bound)


@compiled
def activate(product, bias, row_step, bound):
    """Turn a product (n, m) in place into what the next one takes: with its bias (m,), through the ELU, in steps."""
    for row in range(len(product)):
        for column in range(len(bias)):
            product[row, column] = _steps(_elu(product[row, column] + bias[column]), row_step, bound)


@compiled
def leave(product, bias, source, sign, limit, out):
    """Write actions (n, m) within their limit: the mean of robots and mirror; see ``enter``."""
    n = len(out)
    for row in range(n):
        for column in range(len(bias)):
            other = source[column]
            mirrored = (product[n + row, other] + bias[other]) * sign[column]
            action = 0.5 * ((product[row, column] + bias[column]) + mirrored)
            out[row, column] = min(max(action, -limit), limit)
