"""Simplifications that depend on all uses of an expression.

`c x + c y` becomes `c (x + y)` where nothing else needs the products, and `-(x - y)` becomes
`y - x` where nothing else needs the difference.
"""

from collections import Counter
from collections.abc import Sequence

from jaxid.program.operations import Operation
from jaxid.program.scalar import Operand, Scalar, add, multiply, negate

_SUMS = (Operation.ADD, Operation.SUBTRACT)
_Term = tuple[bool, Operand]
"""Whether a summand is subtracted, and the summand."""


def live_scalars(outputs: Sequence[Operand]) -> list[Scalar]:
    """Return the scalars that the outputs need, each one after its operands."""
    seen, stack = {}, [x for x in outputs if isinstance(x, Scalar)]
    while stack:
        scalar = stack.pop()
        if scalar.index not in seen:
            seen[scalar.index] = scalar
            stack += [x for x in scalar.operands if isinstance(x, Scalar)]
    return [seen[index] for index in sorted(seen)]


def rewrite(outputs: Sequence[Operand]) -> list[Operand]:
    """Return the same outputs with fewer operations, or unchanged if none can be saved."""
    best = list(outputs)
    while True:
        factored = _Rewriting(best).factor_sums()
        if _work(factored) >= _work(best):
            return _Rewriting(best).turn_negated_differences()
        best = factored


def _work(outputs: Sequence[Operand]) -> int:
    free = (Operation.INPUT, Operation.NEGATE)
    return sum(x.operation not in free for x in live_scalars(outputs))


class _Rewriting:
    """One pass over the scalars of some outputs, operands first."""

    def __init__(self, outputs: Sequence[Operand]):
        self.outputs = outputs
        self.scalars = live_scalars(outputs)
        self.uses = Counter(x for x in outputs if isinstance(x, Scalar))
        for scalar in self.scalars:
            self.uses.update(x for x in scalar.operands if isinstance(x, Scalar))
        self.new: dict[Scalar, Operand] = {}

    def factor_sums(self) -> list[Operand]:
        inner = {
            x
            for scalar in self.scalars
            if scalar.operation in _SUMS
            for x in scalar.operands
            if self._is_used_once(x) and x.operation in _SUMS
        }
        for scalar in self.scalars:
            terms = None
            if scalar.operation in _SUMS and scalar not in inner:
                terms = self._factor(_flatten_sum(scalar, inner))
            self.new[scalar] = self._rebuild(scalar) if terms is None else _sum(terms)
        return [self._rewritten(x) for x in self.outputs]

    def turn_negated_differences(self) -> list[Operand]:
        for scalar in self.scalars:
            (x, *_) = scalar.operands
            negates = scalar.operation is Operation.NEGATE and self._is_used_once(x)
            if negates and x.operation is Operation.SUBTRACT:
                left, right = map(self._rewritten, x.operands)
                self.new[scalar] = scalar.graph.node(Operation.SUBTRACT, right, left)
            elif scalar.operation is Operation.INPUT:
                self.new[scalar] = scalar
            else:
                # `_rebuild` would restore the canonical order, and with it the negation.
                operands = map(self._rewritten, scalar.operands)
                self.new[scalar] = scalar.graph.node(scalar.operation, *operands)
        return [self._rewritten(x) for x in self.outputs]

    def _rewritten(self, x: Operand) -> Operand:
        return self.new[x] if isinstance(x, Scalar) else x

    def _is_used_once(self, x: Operand) -> bool:
        return isinstance(x, Scalar) and self.uses[x] == 1

    def _rebuild(self, scalar: Scalar) -> Operand:
        """Return the same operation on rewritten operands."""
        if scalar.operation is Operation.INPUT:
            return scalar
        operands = [self._rewritten(x) for x in scalar.operands]
        if scalar.operation is Operation.ADD:
            return add(*operands)
        if scalar.operation is Operation.SUBTRACT:
            return add(operands[0], negate(operands[1]))
        if scalar.operation is Operation.MULTIPLY:
            return multiply(*operands)
        if scalar.operation is Operation.NEGATE:
            return negate(operands[0])
        return scalar.graph.node(scalar.operation, *operands)

    def _factor(self, terms: list[_Term]) -> list[_Term] | None:
        """Draw common factors out of products that nothing else needs; None if there are none."""
        products = [
            (k, x)
            for k, (_, x) in enumerate(terms)
            if isinstance(x, Scalar) and self._is_used_once(x) and x.operation is Operation.MULTIPLY
        ]
        factored: list[_Term] = []
        used: set[int] = set()
        while True:
            counts = Counter(f for k, x in products if k not in used for f in set(x.operands))
            factor, count = max(
                counts.items(), key=lambda c: (c[1], _order(c[0])), default=(0.0, 0)
            )
            if count < 2:
                break
            group = [(k, x) for k, x in products if k not in used and factor in x.operands]
            rest = [(terms[k][0], self._rewritten(_cofactor(x, factor))) for k, x in group]
            used.update(k for k, _ in group)
            factored.append((False, multiply(self._rewritten(factor), _sum(rest))))
        if not used:
            return None
        others = [(n, self._rewritten(x)) for k, (n, x) in enumerate(terms) if k not in used]
        return others + factored


def _flatten_sum(x: Scalar, inner: set[Scalar]) -> list[_Term]:
    """Return the terms of a sum, with those of the sums inside it."""
    stack: list[tuple[Operand, bool, bool]] = [(x, False, True)]
    terms: list[_Term] = []
    while stack:
        term, negated, outermost = stack.pop()
        if isinstance(term, Scalar) and (outermost or term in inner):
            left, right = term.operands
            stack += [
                (right, negated != (term.operation is Operation.SUBTRACT), False),
                (left, negated, False),
            ]
        else:
            terms.append((negated, term))
    return terms


def _order(x: Operand) -> float:
    """Return a key that breaks ties reproducibly: constants first, then older expressions."""
    return -float(x.index) if isinstance(x, Scalar) else 1.0 + abs(x)


def _cofactor(product: Scalar, factor: Operand) -> Operand:
    x, y = product.operands
    return y if x is factor or x == factor else x


def _sum(terms: list[_Term]) -> Operand:
    total: Operand = 0.0
    for negated, x in terms:
        total = add(total, negate(x) if negated else x)
    return total
