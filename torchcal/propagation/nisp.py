r"""Non-intrusive spectral projection: from α to the mean and standard deviation of the outputs.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 25-29.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchcal import polychaos
from torchcal.checks import as_seed, by_default_on_cpu, positive, whole
from torchcal.data.conditions import checked
from torchcal.embeddings import Embedding, Pattern
from torchcal.errors import DomainError, EmbeddingError, ShapeError
from torchcal.propagation import choice, convergence, parameters, polynomials
from torchcal.propagation.convergence import PropagationCheck
from torchcal.propagation.pieces import CACHED, MANY, MOST, forgetful, over_batch
from torchcal.propagation.projection import prepare
from torchcal.propagation.rules import RuleChoice
from torchcal.simulators import Conditions, Scaling, Simulator, free_parameters

__all__ = ["NISP"]


class NISP(nn.Module):
    r"""Propagates an embedding through a simulator.

    .. math::
        \mu_i(\alpha) = \sum_q w_q f(x_i; \lambda(\xi_q; \alpha)), \qquad
        \sigma_i(\alpha)^2 = \sum_q w_q \bigl(f(x_i; \lambda(\xi_q; \alpha)) - \mu_i\bigr)^2

    or, with ``order=p``, the variance of the expansion of total degree p (Eq. 29). The paper's case studies use
    ``order=1``.

    Args:
        simulator: The model f.
        embedding: Which parameters are uncertain, and how.
        x: Conditions, ``(n,)`` or a dict of them.
        fixed: Parameters to hold, ``{name: physical value}``. Parameters with a neutral value are held there.
        outputs: Names and order of the outputs, where the simulator has several.
        scaling: Coordinates of the free parameters; by default from their bounds or first guesses.
        order: Total degree of the output expansion whose variance is reported; None for the full variance.
        rule: Quadrature nodes and weights; a number of Gauss nodes per germ; or None to find enough by itself
            (exact where the simulator is a polynomial of known degree).
        max_nodes: Most nodes that are chosen by itself.
        trial_spread: Width of the densities on which enough nodes are found: with 1, three sd of a parameter reach
            its bounds, or one sd is one unit of scale where it has none.
        sd_floor: δ in :math:`\sqrt{\sigma^2 + \delta^2}`, which keeps the gradient finite at zero spread; in
            the outputs' unit. By default 1e-8 of the largest mean of an output, below any figure a user reads.
        max_elements: Batch × nodes × outputs evaluated at once. Larger work is cut into pieces, whose
            intermediate values are recomputed in the backward pass. By default 2**24 numbers, 128 MiB; and on a CPU
            pieces that its caches hold, where a simulator that is no polynomial has more than 2**21 to do.

    Raises:
        EmbeddingError: If the embedding does not fit the simulator's free parameters.

    Shapes: ``forward`` maps α ``(*batch, P)`` to mean and sd, ``(*batch, n)`` each, in the outputs' units.

    >>> from torchcal.embeddings import Gaussian
    >>> from torchcal.simulators import Parameter
    >>> line = Simulator(lambda x, p: p["a"] * x, [Parameter("a")])
    >>> mean, sd = NISP(line, Gaussian(), torch.tensor([2.0]).double())(torch.tensor([3.0, 0.5]).double())
    >>> print(f"{float(mean):.3f} {float(sd):.3f}")
    6.000 1.000
    """

    nodes: Tensor
    weights: Tensor
    _psi: Tensor
    _carriers: Tensor
    _projection: Tensor | None
    _template: Tensor
    _places: Tensor
    _table: Tensor | None
    _affine: Tensor | None
    _x0: Tensor

    def __init__(
        self,
        simulator: Simulator,
        embedding: Embedding,
        x: Conditions,
        *,
        fixed: Mapping[str, float] | None = None,
        outputs: Sequence[str] | None = None,
        scaling: Scaling | None = None,
        order: int | None = None,
        rule: polychaos.Rule | RuleChoice | int | None = None,
        max_nodes: int = 4096,
        trial_spread: float = 1.0,
        sd_floor: float | None = None,
        max_elements: int | None = None,
    ) -> None:
        super().__init__()
        by_default_on_cpu()
        if not isinstance(simulator, Simulator):
            raise DomainError(f"Expected a torchcal.Simulator. Got {type(simulator).__name__}. Wrap the function.")
        if not isinstance(embedding, Embedding):
            raise DomainError(f"Expected one of torchcal.embeddings, such as Gaussian(). Got {embedding!r}.")
        order = None if order is None else whole("order", order, 1, also="or None")
        if scaling is not None and not isinstance(scaling, Scaling):
            raise DomainError(f"Expected scaling as a torchcal.simulators.Scaling or None. Got {scaling!r}.")
        self.simulator = simulator
        self.embedding = embedding
        self.free, self.held = free_parameters(simulator.parameters, fixed)
        self.fixed = dict(fixed or {})
        self.pattern: Pattern = embedding.bind([parameter.name for parameter in self.free])
        self.scaling = scaling if scaling is not None else Scaling.from_parameters(self.free)
        self._check_finite_moments()
        self.outputs = None if outputs is None else tuple(outputs)
        self.order = order
        self.max_nodes = whole("max_nodes", max_nodes, 1)
        self.trial_spread = positive("trial_spread", trial_spread)
        self.sd_floor = None if sd_floor is None else positive("sd_floor", sd_floor)
        self.max_elements = None if max_elements is None else whole("max_elements", max_elements, 1)
        x = checked(x, tuple(x) if isinstance(x, Mapping) else None)
        # What it is made of its constructor says: no buffer is state that could be loaded into another one.
        self._x_names = tuple(x) if isinstance(x, Mapping) else None
        for i, value in enumerate(x.values() if isinstance(x, Mapping) else [x]):
            self.register_buffer(f"_x{i}", value.detach().to("cpu", torch.float64), persistent=False)
        position = {name: i for i, name in enumerate(self.pattern.names)}
        self.register_buffer(
            "_template",
            torch.tensor([self.held.get(name, 0.0) for name in simulator.names], dtype=torch.float64),
            persistent=False,
        )
        places = torch.tensor([i for i, name in enumerate(simulator.names) if name in position])
        self.register_buffer("_places", places, persistent=False)
        self._evaluate: Callable[[Tensor], Tensor] | None = None
        self._polynomial: Tensor | None = None
        found, self.degree = polynomials.expansion(self)
        self._is_polynomial = found is not None
        found = found if found is not None and found.pays else None
        self.register_buffer("_table", None if found is None else found.table, persistent=False)
        self._polynomial = None if found is None else found.terms
        self._wanted_rule = rule
        self.set_rule(choice.choose(self, rule))

    # --- what it is --------------------------------------------------------------------------------------

    @property
    def num_alpha(self) -> int:
        """P, the number of coefficients α."""
        return self.pattern.num_alpha

    @property
    def alpha_names(self) -> tuple[str, ...]:
        """The names of α."""
        return self.pattern.alpha_names

    @property
    def x(self) -> Conditions:
        """The conditions, on the module's device."""
        if self._x_names is None:
            return self._x0
        return {name: getattr(self, f"_x{i}") for i, name in enumerate(self._x_names)}

    @property
    def rule_choice(self) -> RuleChoice:
        """The family and size of the quadrature rule in use."""
        return self._choice

    @property
    def num_nodes(self) -> int:
        """The number of quadrature nodes."""
        return len(self.nodes)

    @property
    def num_evaluations(self) -> int:
        """The number of nodes that moments of one α take: fewer than all of them for a polynomial of known degree."""
        return len(self._carriers)

    def extra_repr(self) -> str:
        """Shown by ``print``."""
        return f"alpha={list(self.alpha_names)}, nodes={self.num_nodes}, order={self.order or 'full'}"

    def __getstate__(self) -> dict[str, Any]:
        # The simulator at its conditions is a closure, which no process can be sent.
        return {**self.__dict__, "_evaluate": None}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "NISP":
        self._evaluate = None
        return super()._apply(fn, recurse)

    # --- moments -----------------------------------------------------------------------------------------

    def forward(self, alpha: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and sd of the outputs, ``(*batch, n)`` each.

        Raises:
            EmbeddingError: If nothing is embedded: there is then no model-error sd. Use `mean`.
        """
        mean, variance = self.moments(alpha)
        return mean, (variance + self.floor(mean).square()).sqrt()

    def floor(self, mean: Tensor) -> Tensor:
        """δ for outputs with this mean, ``(*batch, n)`` or one number."""
        if self.sd_floor is not None:
            return torch.full_like(mean[..., :1], self.sd_floor)
        smallest = torch.finfo(mean.dtype).tiny ** 0.25  # its square is still a number
        return (1e-8 * self.largest(mean.detach().abs())).clamp_min(smallest)

    def largest(self, values: Tensor) -> Tensor:
        """The largest of each output's values, in the place of every value of that output, ``(*batch, n)``."""
        split = values.unflatten(-1, (-1, len(self._x0)))  # one output after another
        return split.amax(-1, keepdim=True).expand(split.shape).reshape(values.shape)

    def moments(self, alpha: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the outputs, ``(*batch, n)`` each, without the floor of `forward`."""
        self._check_alpha(alpha)
        if self.pattern.num_germs == 0:
            raise EmbeddingError(
                "Expected an embedding with at least one uncertain parameter where a model-error sd is asked "
                "for. Got none. Use NISP.mean(alpha) for the outputs alone."
            )
        mean, variance = self._in_pieces(alpha, self._moments)
        return mean, variance

    def mean(self, alpha: Tensor) -> Tensor:
        """Mean of the outputs, ``(*batch, n)``; the outputs themselves where nothing is embedded."""
        self._check_alpha(alpha)
        return self._in_pieces(alpha, lambda block: (self._mean(block)[..., 0, :],))[0]

    def coefficients(self, alpha: Tensor, order: int | None = None) -> tuple[Tensor, Tensor]:
        r"""The output's expansion, :math:`c_{ik} = \langle f_i \Psi_k \rangle / \langle \Psi_k^2 \rangle`.

        Args:
            alpha: ``(*batch, P)``.
            order: Total degree; by default ``self.order``, else the largest that the rule can carry.

        Returns:
            Coefficients ``(*batch, n, K)`` and their multi-indices ``(K, germs)``.

        Source: Sargsyan, Najm & Ghanem (2015), Eqs. 25-27.
        """
        self._check_alpha(alpha)
        if order is None:
            order = self.order or self._choice.expansion_order(self.pattern.num_germs)
        indices = polychaos.multi_indices(self.pattern.num_germs, order)
        matrix = polychaos.evaluate(self.pattern.basis, indices, self.nodes) * self.weights[:, None]
        matrix = matrix / polychaos.norms(self.pattern.basis, indices).to(matrix)
        (result,) = self._in_pieces(alpha, lambda block: (self._weighted(block, matrix, self._psi).transpose(-1, -2),))
        return result, indices

    def parameters_at(self, alpha: Tensor, xi: Tensor, *, paired: bool = False) -> Tensor:
        """λ(ξ; α) of the free parameters in physical units, ``(*batch, S, d)``, at germs ``(S, germs)``.

        With ``paired`` the germs are ``(*batch, germs)``, one for each α, and the result ``(*batch, d)``.
        """
        self._check_alpha(alpha)
        psi = polychaos.evaluate(self.pattern.basis, self.pattern.indices, xi.to(alpha))
        form = "...dk,...k->...d" if paired else "...dk,sk->...sd"
        return self.scaling.physical(torch.einsum(form, self.pattern.matrix(alpha), psi))

    def outputs_at(self, alpha: Tensor, xi: Tensor, *, paired: bool = False) -> Tensor:
        """f(x; λ(ξ; α)), ``(*batch, S, n)``, at germs ``(S, germs)``; ``(*batch, n)`` with ``paired``."""
        return self._simulate(self.parameters_at(alpha, xi, paired=paired))

    def with_held(self, values: Tensor) -> Tensor:
        """Values of all the simulator's parameters ``(*batch, all)`` from those of the free ones ``(*batch, d)``."""
        if not self.held:
            return values
        template = self._template.to(values).expand(*values.shape[:-1], -1)
        return template.index_copy(-1, self._places, values)

    def draw_germ(self, num: int, *, seed: int) -> Tensor:
        """Independent draws of ξ, ``(num, germs)``."""
        num, generator = whole("num", num, 0), torch.Generator().manual_seed(as_seed(seed))
        draws = self.pattern.basis.sample((num, self.pattern.num_germs), generator=generator)
        return draws.to(self.nodes)

    def sample(self, alpha: Tensor, num: int, *, seed: int) -> Tensor:
        """Draws from the output's density, ``(*batch, num, n)``, the same germs for every α."""
        return self.outputs_at(alpha, self.draw_germ(num, seed=seed))

    def parameter_moments(self, alpha: Tensor) -> tuple[Tensor, Tensor]:
        r"""E[λ] ``(*batch, d)`` and Cov[λ] ``(*batch, d, d)`` of the free parameters, physical units (Eq. 9).

        A parameter on a logarithmic scale has the moments of exp(λ): exact for normal germs of the first order,
        :math:`E = \exp(m + v/2)`, and of the second, where they may be +inf; by Gauss nodes for others.
        """
        self._check_alpha(alpha)
        return parameters.moments(self, alpha)

    # --- the same embedding elsewhere --------------------------------------------------------------------

    def at(self, x: Conditions, *, simulator: Simulator | None = None) -> "NISP":
        """The same embedding, rule and coordinates at other conditions, or for another function of λ.

        Args:
            x: New conditions.
            simulator: Another simulator of the same parameters, for another quantity of interest.
        """
        if simulator is None:
            return self.copy(x=x)
        return self.copy(x=x, simulator=simulator, outputs=None, sd_floor=None, rule=self._wanted_rule)

    def copy(self, **changes: Any) -> "NISP":
        """The same propagation with some of its constructor's arguments changed."""
        settings: dict[str, Any] = {
            "simulator": self.simulator,
            "embedding": self.embedding,
            "x": self.x,
            "fixed": self.fixed,
            "outputs": self.outputs,
            "scaling": self.scaling,
            "order": self.order,
            "rule": self._choice,
            "max_nodes": self.max_nodes,
            "trial_spread": self.trial_spread,
            "sd_floor": self.sd_floor,
            "max_elements": self.max_elements,
        }
        other = NISP(**{**settings, **changes})
        return other.to(device=self.nodes.device, dtype=self.nodes.dtype)

    # --- convergence -------------------------------------------------------------------------------------

    def check(
        self, alpha: Tensor, *, tolerance: float = 1e-6, order_tolerance: float = 0.05, warn: bool = True
    ) -> PropagationCheck:
        """Hold the moments at α against a finer rule, and the expansion against the full variance.

        Args:
            alpha: Where to look, ``(*batch, P)``.
            tolerance: Largest change, relative to the output's scale, that passes. The default is far below
                the Monte Carlo error of any posterior.
            order_tolerance: Largest share of a variance above ``order`` that passes.
            warn: Whether to warn when it does not pass.

        Warns:
            PropagationWarning: With the numbers.
        """
        result = convergence.compare(self, alpha)
        if warn:
            convergence.warn_unsettled(
                result, self.order, tolerance, order_tolerance, stalled=self._choice.stalled
            )
        return result

    def refine(self, alpha: Tensor, *, tolerance: float = convergence.SETTLED) -> bool:
        """Take more nodes until the moments at α settle, or the outermost of more are values that f does not bear.

        Where finer rules cease to change them less, as where outputs are rounded, the smallest of these stays.

        Args:
            alpha: Where they are to settle, ``(*batch, P)``.
            tolerance: Change, relative to the output's scale, that counts as settled.

        Returns:
            Whether the rule has changed.
        """
        before, germs = self._choice.size, self.pattern.num_germs
        sizes: list[int] = []
        changes: list[float] = []
        while germs and self._choice.kind == "tensor" and choice.exact_count(self) is None:
            finer = self._choice.finer(germs, self.pattern.basis)
            if finer is None or finer.size**germs > self.max_nodes:
                break
            result = self.check(alpha, warn=False)
            change = max(result.mean_change, result.sd_change)
            if change <= tolerance or not math.isfinite(result.mean_change + result.sd_change):
                break
            sizes.append(self._choice.size)
            changes.append(change)
            if convergence.has_stalled(self, changes):
                self.set_rule(RuleChoice("tensor", sizes[convergence.first_as_good(changes)], stalled=True))
                break
            self.set_rule(finer)
        return self._choice.size != before

    # --- inside ------------------------------------------------------------------------------------------

    def _check_finite_moments(self) -> None:
        pattern = self.pattern
        endless = [q.name for q in self.free if q.transform == "log" and q.name in pattern.embedded]
        if pattern.basis.name == "hermite" and pattern.order > 2 and endless:
            raise EmbeddingError(
                f"Expected an expansion of order 2 at most in normal germs for {', '.join(endless)} with "
                f"transform='log': exp of a cubic in a normal variable has no mean. Got order {pattern.order}. Use "
                "germ='legendre', a lower order, or no transform."
            )

    def _check_alpha(self, alpha: Tensor) -> None:
        if not isinstance(alpha, Tensor):
            raise ShapeError(f"Expected alpha as a tensor (*batch, {self.num_alpha}). Got {type(alpha).__name__}.")
        if alpha.ndim < 1 or alpha.shape[-1] != self.num_alpha:
            raise ShapeError(
                f"Expected alpha of shape (*batch, {self.num_alpha}): {', '.join(self.alpha_names)}. "
                f"Got {tuple(alpha.shape)}."
            )
        if alpha.dtype != self.nodes.dtype:
            raise ShapeError(
                f"Expected alpha of dtype {self.nodes.dtype}. Got {alpha.dtype}. Convert it, or move the module "
                "with .to(dtype)."
            )

    def _outputs(self, alpha: Tensor, psi: Tensor) -> Tensor:
        """Outputs ``(*batch, S, n)`` at rows of Ψ, ``(S, K)``."""
        return self._finished(self._features(alpha, psi))

    def _features(self, alpha: Tensor, psi: Tensor) -> Tensor:
        """What outputs are linear in, ``(*batch, S, M)``: Legendre products of the parameters, or the outputs."""
        scaled = psi @ self.pattern.matrix(alpha).transpose(-1, -2)
        if self._polynomial is not None:
            return polychaos.evaluate(polychaos.LEGENDRE, self._polynomial, scaled)
        return self._simulate(self.scaling.physical(scaled))

    def _finished(self, features: Tensor) -> Tensor:
        """Outputs ``(*batch, S, n)`` of (sums of) features."""
        return features if self._table is None else features @ self._table

    def _simulate(self, values: Tensor) -> Tensor:
        """Outputs ``(*batch, n)`` at values of the free parameters ``(*batch, d)``."""
        if self._evaluate is None:
            self._evaluate = self.simulator.at(self.x, self.outputs)
        return self._evaluate(self.with_held(values))

    def _mean(self, alpha: Tensor) -> Tensor:
        """The outputs' mean ``(*batch, 1, n)``."""
        if self._projection is None:
            return self._weighted(alpha, self.weights[:, None], self._psi)
        return self._weighted(alpha, self._projection[:, :1], self._carriers)

    def _weighted(self, alpha: Tensor, matrix: Tensor, psi: Tensor) -> Tensor:
        """Σ_q matrix[q, k] f_q, shape ``(*batch, k, n)``, node piece by node piece."""
        pieces = self._node_pieces(alpha, len(psi))

        def part(block: Tensor, piece: slice) -> tuple[Tensor]:
            return (matrix[piece].transpose(-1, -2) @ self._features(block, psi[piece]),)

        if len(pieces) == 1:
            return self._finished(part(alpha, pieces[0])[0])
        return self._finished(
            functools.reduce(
                torch.add, (forgetful(functools.partial(part, piece=piece), alpha)[0] for piece in pieces)
            )
        )

    def _linear(self, alpha: Tensor, affine: Tensor, count: int) -> Tensor:
        """Expansion coefficients ``(*batch, k, n)`` of outputs that are linear in the parameters."""
        rows = alpha.reshape(-1, self.num_alpha)
        features = torch.addmm(affine[0], rows, affine[1:])
        return self._finished(features.reshape(*alpha.shape[:-1], count, affine.shape[1] // count))

    def _moments(self, alpha: Tensor) -> tuple[Tensor, Tensor]:
        if self._projection is not None:
            if self._affine is None:
                terms = self._weighted(alpha, self._projection, self._carriers)
            else:
                terms = self._linear(alpha, self._affine, self._projection.shape[1])
            return terms[..., 0, :], terms[..., 1:, :].square().sum(-2)
        pieces = self._node_pieces(alpha, self.num_nodes)
        if len(pieces) == 1:
            outputs = self._outputs(alpha, self._psi)
            mean = self.weights @ outputs
            offset = outputs - mean.unsqueeze(-2)
            return mean, self.weights @ offset.square()
        with torch.no_grad():  # a shift near the mean keeps the sum of squares from cancelling
            shift = self._mean(alpha.detach())

        def sums(block: Tensor, piece: slice) -> tuple[Tensor, Tensor]:
            offset = self._outputs(block, self._psi[piece]) - shift
            return self.weights[piece] @ offset, self.weights[piece] @ offset.square()

        first = second = alpha.new_zeros(())
        for piece in pieces:
            one, two = forgetful(functools.partial(sums, piece=piece), alpha)
            first, second = first + one, second + two
        return shift[..., 0, :] + first, (second - first.square()).clamp_min(0)

    def _node_pieces(self, alpha: Tensor, count: int) -> list[slice]:
        rows = alpha.numel() // self.num_alpha * self._width
        size = max(1, (self.max_elements or MOST) // max(1, rows))
        return [slice(i, i + size) for i in range(0, count, size)]

    @property
    def _width(self) -> int:
        """Numbers that one node of one α takes: its outputs, or the functions that they are linear in."""
        return max(self._n, 0 if self._polynomial is None else len(self._polynomial))

    @property
    def _n(self) -> int:
        return self._x0.shape[0] * (1 if self.outputs is None else len(self.outputs))

    def _in_pieces(
        self, alpha: Tensor, function: Callable[[Tensor], tuple[Tensor, ...]]
    ) -> tuple[Tensor, ...]:
        """Apply a function of a batch of α in pieces of bounded size."""
        single = max(1, self.num_nodes * self._width)
        most = self.max_elements or MOST
        size = self._cached(alpha) or max(1, most // single)
        return over_batch(function, alpha, size, whole=single <= most)

    def _cached(self, alpha: Tensor) -> int | None:
        """How many α are evaluated at once where that is a matter of a CPU's caches."""
        if self.max_elements is not None or self.simulator.dear or self._polynomial is not None:
            return None
        single = max(1, self.num_evaluations * self._width)
        if self.nodes.device.type != "cpu" or alpha.numel() // self.num_alpha * single <= MANY:
            return None
        return max(1, CACHED // single)

    # --- rules -------------------------------------------------------------------------------------------

    def set_rule(self, rule_choice: RuleChoice) -> None:
        """Use another quadrature rule."""
        found = prepare(self, rule_choice)
        self._choice = rule_choice
        for name, value in (
            ("nodes", found.nodes),
            ("weights", found.weights),
            ("_psi", found.psi),
            ("_carriers", found.carriers),
            ("_projection", found.projection),
            ("_affine", found.affine),
        ):
            # Built in float64 and only then cast, so that the rule is as good as the dtype allows.
            cast = None if value is None else value.to(self._template)
            self.register_buffer(name, cast, persistent=False)
