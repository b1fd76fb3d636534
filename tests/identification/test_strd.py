"""Least squares beside NIST's certified values (Statistical Reference Datasets)."""

import numpy as np
import pytest

from jaxid.identification.estimators.regularisation_and_weights import Decomposition
from jaxid.identification.factors import empty_factors


def numbers(text):
    return np.array([float(word) for word in text.split()])


def powers(x, degree):
    return np.column_stack([x**k for k in range(degree + 1)])


FILIP = numbers(
    "-6.860120914 -4.324130045 -4.358625055 -4.358426747 -6.955852379 -6.661145254 "
    "-6.355462942 -6.118102026 -7.115148017 -6.815308569 -6.519993057 -6.204119983 "
    "-5.853871964 -6.109523091 -5.79832982 -5.482672118 -5.171791386 -4.851705903 "
    "-4.517126416 -4.143573228 -3.709075441 -3.499489089 -6.300769497 -5.953504836 "
    "-5.642065153 -5.031376979 -4.680685696 -4.329846955 -3.928486195 -8.56735134 "
    "-8.363211311 -8.107682739 -7.823908741 -7.522878745 -7.218819279 -6.920818754 "
    "-6.628932138 -6.323946875 -5.991399828 -8.781464495 -8.663140179 -8.473531488 "
    "-8.247337057 -7.971428747 -7.676129393 -7.352812702 -7.072065318 -6.774174009 "
    "-6.478861916 -6.159517513 -6.835647144 -6.53165267 -6.224098421 -5.910094889 "
    "-5.598599459 -5.290645224 -4.974284616 -4.64454848 -4.290560426 -3.885055584 "
    "-3.408378962 -3.13200249 -8.726767166 -8.66695597 -8.511026475 -8.165388579 "
    "-7.886056648 -7.588043762 -7.283412422 -6.995678626 -6.691862621 -6.392544977 "
    "-6.067374056 -6.684029655 -6.378719832 -6.065855188 -5.752272167 -5.132414673 "
    "-4.811352704 -4.098269308 -3.66174277 -3.2644011"
)
FILIP_Y = numbers(
    "0.8116 0.9072 0.9052 0.9039 0.8053 0.8377 0.8667 0.8809 0.7975 0.8162 0.8515 "
    "0.8766 0.8885 0.8859 0.8959 0.8913 0.8959 0.8971 0.9021 0.909 0.9139 0.9199 "
    "0.8692 0.8872 0.89 0.891 0.8977 0.9035 0.9078 0.7675 0.7705 0.7713 0.7736 0.7775 "
    "0.7841 0.7971 0.8329 0.8641 0.8804 0.7668 0.7633 0.7678 0.7697 0.77 0.7749 0.7796 "
    "0.7897 0.8131 0.8498 0.8741 0.8061 0.846 0.8751 0.8856 0.8919 0.8934 0.894 0.8957 "
    "0.9047 0.9129 0.9209 0.9219 0.7739 0.7681 0.7665 0.7703 0.7702 0.7761 0.7809 "
    "0.7961 0.8253 0.8602 0.8809 0.8301 0.8664 0.8834 0.8898 0.8964 0.8963 0.9074 "
    "0.9119 0.9228"
)
LONGLEY = numbers(
    "83.0 234289 2356 1590 107608 1947 88.5 259426 2325 1456 108632 1948 88.2 258054 "
    "3682 1616 109773 1949 89.5 284599 3351 1650 110929 1950 96.2 328975 2099 3099 "
    "112075 1951 98.1 346999 1932 3594 113270 1952 99.0 365385 1870 3547 115094 1953 "
    "100.0 363112 3578 3350 116219 1954 101.2 397469 2904 3048 117388 1955 104.6 "
    "419180 2822 2857 118734 1956 108.4 442769 2936 2798 120445 1957 110.8 444546 4681 "
    "2637 121950 1958 112.6 482704 3813 2552 123366 1959 114.2 502601 3931 2514 125368 "
    "1960 115.7 518173 4806 2572 127852 1961 116.9 554894 4007 2827 130081 1962"
)
LONGLEY_Y = numbers(
    "60323 61122 60171 61187 63221 63639 64989 63761 66019 67857 68169 66513 68655 "
    "69564 69331 70551"
)
WAMPLER = np.arange(21.0)
WAMPLER_ERRORS = numbers(
    "759 -2048 2048 -2048 2523 -2048 2048 -2048 1838 -2048 2048 -2048 1838 -2048 2048 "
    "-2048 2523 -2048 2048 -2048 759"
)
"""Errors that are added to Wampler's problems 3, 4 and 5, 1, 100 and 10000 times."""
WAMPLER_DEVIATIONS = numbers(
    "2152.32624678170 2363.55173469681 779.343524331583 101.475507550350 "
    "5.64566512170752 0.112324854679312"
)


def wampler(coefficients, errors):
    X = powers(WAMPLER, 5)
    y = X @ np.array(coefficients) + errors * WAMPLER_ERRORS
    return X, y, np.array(coefficients), errors * WAMPLER_DEVIATIONS


PROBLEMS = {
    "Filip": (
        powers(FILIP, 10),
        FILIP_Y,
        numbers(
            "-1467.48961422980 -2772.17959193342 -2316.37108160893 -1127.97394098372 "
            "-354.478233703349 -75.1242017393757 -10.8753180355343 -1.06221498588947 "
            "-0.670191154593408e-01 -0.246781078275479e-02 -0.402962525080404e-04"
        ),
        numbers(
            "298.084530995537 559.779865474950 466.477572127796 227.204274477751 "
            "71.6478660875927 15.2897178747400 2.23691159816033 0.221624321934227 "
            "0.142363763154724e-01 0.535617408889821e-03 0.896632837373868e-05"
        ),
    ),
    "Longley": (
        np.column_stack([np.ones(16), LONGLEY.reshape(16, 6)]),
        LONGLEY_Y,
        numbers(
            "-3482258.63459582 15.0618722713733 -0.358191792925910e-01 "
            "-2.02022980381683 -1.03322686717359 -0.511041056535807e-01 "
            "1829.15146461355"
        ),
        numbers(
            "890420.383607373 84.9149257747669 0.334910077722432e-01 0.488399681651699 "
            "0.214274163161675 0.226073200069370 455.478499142212"
        ),
    ),
    "Wampler1": wampler([1.0] * 6, 0),
    "Wampler2": wampler([10.0**-k for k in range(6)], 0),
    "Wampler3": wampler([1.0] * 6, 1),
    "Wampler4": wampler([1.0] * 6, 100),
    "Wampler5": wampler([1.0] * 6, 10_000),
}
DIGITS = dict(zip(PROBLEMS, (6, 10, 8, 11, 8, 7, 5), strict=True))
"""Digits that all estimates of a problem have at least, with any order of the rows."""


def solved(X, y):
    """By the way that identification takes: a joint's factor, its decomposition."""
    size = X.shape[1]
    factors = empty_factors([tuple(range(size))], size)
    for part in np.array_split(np.column_stack([X, y]), 2):
        factors = factors.append([part])
    return Decomposition.of(*factors.weighted(np.ones(1)))


def digits(found, known):
    error = np.abs(np.asarray(found) - known) / np.abs(known)
    return float(-np.log10(max(error.max(), 1e-15)))


@pytest.mark.parametrize("name", PROBLEMS)
def test_certified_digits_are_reached_in_any_order_of_the_rows_and_any_units(name):
    X, y, certified, _ = PROBLEMS[name]
    random = np.random.default_rng(3)
    order, units = (
        random.permutation(len(y)),
        2.0 ** random.integers(-9, 10, X.shape[1]),
    )
    for rows, unit in ((slice(None), 1.0), (order, 1.0), (slice(None), units)):
        p = solved(X[rows] * unit, y[rows]).solve()
        assert digits(p * unit, certified) >= DIGITS[name]


@pytest.mark.parametrize("name", ["Filip", "Longley", "Wampler3"])
def test_certified_standard_deviations_are_reached(name):
    X, y, _, certified = PROBLEMS[name]
    found = solved(X, y)
    rest = found.rest / np.sqrt(X.shape[0] - X.shape[1])
    deviations = rest * np.sqrt(np.diag(found.inverse_information()))
    # What is left of the responses is a difference: it has fewer digits than they have.
    assert digits(deviations, certified) >= 5
