"""Compiled loops over worlds: what ``control`` means, number by number, without NumPy's cost a call.

Each kernel carries out the very additions and multiplications of the NumPy functions that it stands for, in their
order, and takes sines, cosines and arctangents from the C library as NumPy does; numba neither reorders nor fuses them.
So its bits are NumPy's, for any number of worlds. Tests compare both, bit for bit. What each function means, its units
and its sources are written at the NumPy function of the same name, in the module that a file here names first.
"""
