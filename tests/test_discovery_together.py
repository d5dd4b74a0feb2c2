"""Several terms that explain a recording together, and are no names: they bend to what is in no list."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.verdicts.together import only_together

F64 = torch.float64
X = torch.linspace(0.2, 5, 60, dtype=F64)


def noise(seed, sd=0.01):
    return sd * torch.randn(60, generator=torch.Generator().manual_seed(seed), dtype=F64)


def plus(name, function, amplitude):
    return tc.Term(name, outputs={"y": lambda x, p, y: y + p[amplitude] * function(x)},
                   parameters=[tc.Parameter(amplitude)])  # fmt: skip


LINE = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])


def diagnose(y, candidates, base=LINE, **options):
    return tc.diagnose(base, tc.Recording(x=X, y=y, noise=0.01), candidates, seed=0, progress=False, **options)


def test_two_terms_that_differ_are_named():
    def bump(x):
        return torch.exp(-(((x - 2) / 0.4) ** 2))

    def wave(x):
        return torch.sin(3 * x)

    y = 1 + 0.5 * X + 0.2 * bump(X) + 0.1 * wave(X) + noise(0)
    d = diagnose(y, [plus("bump", bump, "h"), plus("wave", wave, "w")])
    assert (d.verdict, set(d.terms)) == ("named", {"bump", "wave"})


def test_two_terms_between_which_one_law_lies_are_no_names():
    pair = [plus("square", lambda x: x**2, "q"), plus("fourth", lambda x: x**4, "c")]
    d = diagnose(1 + 0.5 * X + 0.05 * X**3 + noise(1), pair)
    assert d.verdict in ("ambiguous", "unexplained")
    assert d.verdict == "unexplained" or ["none of these"] in d.tied
    told = " ".join(str(d).split())
    assert d.verdict == "unexplained" or "one law may look like both" in told


def test_a_term_that_the_base_can_do_alone_is_no_name_beside_another():
    base = tc.Simulator(
        lambda x, p: p["a"] * (1 - torch.exp(-p["k"] * x)) + p["c"],
        [tc.Parameter("a", initial=1.0), tc.Parameter("k", initial=1.0), tc.Parameter("c")],
    )
    offset, bent = plus("offset", lambda x: 1 + 0 * x, "o"), plus("bent", lambda x: x**2, "q")
    y = 1 - torch.exp(-X) + 0.02 * X**2 + noise(2)
    d = diagnose(y, [offset, bent], base)
    assert (d.verdict, d.terms) == ("named", ["bent"])


def conductivities(viscosity, seed, **options):
    """Molar conductivity by Kohlrausch's law, lowered by viscosity, which is not among the candidates."""
    rng = np.random.default_rng(seed)
    c = torch.tensor(np.repeat([5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15, 0.2], 3))
    warm = torch.tensor(np.tile([-5.0, 0.0, 5.0], 12))
    y = (130 * (1 + 0.02 * warm) - 80 * c.sqrt()) * (1 - viscosity * c) + 0.06 * torch.tensor(rng.standard_normal(36))

    def pairing(x, p, y):
        free = 2 / (1 + torch.sqrt(1 + 4 * p["K"] * x["c"]))
        whole = p["L0"] * (1 + p["al"] * x["warm"])
        return y + free * (whole - p["S"] * torch.sqrt(free * x["c"])) - (whole - p["S"] * torch.sqrt(x["c"]))

    base = tc.Simulator(
        lambda x, p: p["L0"] * (1 + p["al"] * x["warm"]) - p["S"] * torch.sqrt(x["c"]),
        [tc.Parameter("L0", low=0.0, initial=120.0), tc.Parameter("S", low=0.0, initial=70.0),
         tc.Parameter("al", initial=0.02)],
    )  # fmt: skip
    candidates = [
        tc.Term("ion pairing", outputs={"y": pairing}, parameters=[tc.Parameter("K", low=0.0)]),
        tc.Term("solvent", outputs={"y": lambda x, p, y: y + p["k"] / x["c"]}, parameters=[tc.Parameter("k", low=0.0)]),
        *tc.terms.sensor(outputs=("y",), static=True),
    ]
    recording = tc.Recording(x={"c": c, "warm": warm}, y=y, **options)
    return tc.diagnose(base, recording, candidates, seed=0, progress=False)


@pytest.mark.slow
def test_an_offset_that_the_base_can_do_alone_makes_no_name_of_what_it_stands_beside():
    named = []
    for seed in range(1000, 1003):
        d = conductivities(0.172, seed, noise=0.06)
        named += [d.terms] if d.verdict == "named" else []
        if ["ion pairing", "offset of y"] in d.tied:
            assert ["none of these"] in d.tied
            assert "Alone, offset of y does what the base's own parameters do" in " ".join(str(d).split())
    assert not named


@pytest.mark.slow
def test_what_all_likely_hypotheses_share_is_no_name_where_the_best_of_them_is_none():
    for seed in range(2000, 2003):
        d = conductivities(0.108, seed)
        assert d.verdict in ("ambiguous", "unexplained")
        assert d.verdict == "unexplained" or ["none of these"] in d.tied


@pytest.mark.parametrize("names", [("a",), ("a", "b")])
@pytest.mark.parametrize(("left", "doubted"), [(0.5, True), (0.01, False)])
def test_what_only_pairs_have_shown_in_few_data_is_no_name_of_one_either(names, left, doubted):
    fit = SimpleNamespace(residual=torch.full((10,), left))
    base = SimpleNamespace(residual=torch.ones(10))
    search = SimpleNamespace(paired=True, exact=True, base=base)
    told = only_together(search, SimpleNamespace(names=names, found=fit))
    assert ("So few data" in told) is doubted
