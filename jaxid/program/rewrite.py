"""Simplifications that need to know who else uses an expression.

`c x + c y` becomes `c (x + y)` where nothing else needs the products, and `-(x - y)` becomes
`y - x` where nothing else needs the difference.
"""

from collections import Counter
from collections.abc import Sequence

from jaxid.program.operation import Operation
from jaxid.program.scalar import Operand, Scalar, add, multiply, negate

_SUMS = (Operation.ADD, Operation.SUBTRACT)
_Term = tuple[bool, Operand]
"""Whether a summand is subtracted, and the summand."""


def live(outputs: Sequence[Operand]) -> list[Scalar]:
    """The scalars that the outputs need, each one after its operands."""
    seen, stack = {}, [x for x in outputs if isinstance(x, Scalar)]
    while stack:
        scalar = stack.pop()
        if scalar.index not in seen:
            seen[scalar.index] = scalar
            stack += [x for x in scalar.operands if isinstance(x, Scalar)]
    return [seen[index] for index in sorted(seen)]


def rewrite(outputs: Sequence[Operand]) -> list[Operand]:
    """The same outputs with fewer operations, or as they were if nothing is to be gained."""
    best = list(outputs)
    while True:
        factored = _Rewriting(best).factored()
        if _work(factored) >= _work(best):
            return _Rewriting(best).without_negated_differences()
        best = factored


def _work(outputs: Sequence[Operand]) -> int:
    free = (Operation.INPUT, Operation.NEGATE)
    return sum(x.operation not in free for x in live(outputs))


class _Rewriting:
    """One pass over the scalars of some outputs, operands first."""

    def __init__(self, outputs: Sequence[Operand]):
        self.outputs = outputs
        self.scalars = live(outputs)
        self.uses = Counter(x for x in outputs if isinstance(x, Scalar))
        for scalar in self.scalars:
            self.uses.update(x for x in scalar.operands if isinstance(x, Scalar))
        self.new: dict[Scalar, Operand] = {}

    def factored(self) -> list[Operand]:
        inner = {
            x
            for scalar in self.scalars
            if scalar.operation in _SUMS
            for x in scalar.operands
            if self._once(x) and x.operation in _SUMS
        }
        for scalar in self.scalars:
            terms = None
            if scalar.operation in _SUMS and scalar not in inner:
                terms = self._factor(self._terms(scalar, False, inner))
            self.new[scalar] = self._again(scalar) if terms is None else _total(terms)
        return [self._of(x) for x in self.outputs]

    def without_negated_differences(self) -> list[Operand]:
        for scalar in self.scalars:
            (x, *_) = scalar.operands
            negates = scalar.operation is Operation.NEGATE and self._once(x)
            if negates and x.operation is Operation.SUBTRACT:
                left, right = map(self._of, x.operands)
                self.new[scalar] = scalar.graph.node(Operation.SUBTRACT, right, left)
            elif scalar.operation is Operation.INPUT:
                self.new[scalar] = scalar
            else:
                # Not by `_again`: its canonical order would bring the negation back.
                self.new[scalar] = scalar.graph.node(
                    scalar.operation, *map(self._of, scalar.operands)
                )
        return [self._of(x) for x in self.outputs]

    def _of(self, x: Operand) -> Operand:
        return self.new[x] if isinstance(x, Scalar) else x

    def _once(self, x: Operand) -> bool:
        return isinstance(x, Scalar) and self.uses[x] == 1

    def _again(self, scalar: Scalar) -> Operand:
        """The same operation on operands that may have become others."""
        if scalar.operation is Operation.INPUT:
            return scalar
        operands = [self._of(x) for x in scalar.operands]
        if scalar.operation is Operation.ADD:
            return add(*operands)
        if scalar.operation is Operation.SUBTRACT:
            return add(operands[0], negate(operands[1]))
        if scalar.operation is Operation.MULTIPLY:
            return multiply(*operands)
        if scalar.operation is Operation.NEGATE:
            return negate(operands[0])
        return scalar.graph.node(scalar.operation, *operands)

    def _terms(self, x: Operand, negated: bool, inner: set[Scalar]) -> list[_Term]:
        stack, terms = [(x, negated, True)], []
        while stack:
            x, negated, outermost = stack.pop()
            if isinstance(x, Scalar) and (outermost or x in inner):
                left, right = x.operands
                stack += [
                    (right, negated != (x.operation is Operation.SUBTRACT), False),
                    (left, negated, False),
                ]
            else:
                terms.append((negated, x))
        return terms

    def _factor(self, terms: list[_Term]) -> list[_Term] | None:
        """Draws common factors out of products that nothing else needs; None if there are none."""
        products = [
            (k, x)
            for k, (_, x) in enumerate(terms)
            if isinstance(x, Scalar) and self._once(x) and _is_product(x)
        ]
        done: list[_Term] = []
        taken: set[int] = set()
        while True:
            counts = Counter(f for k, x in products if k not in taken for f in set(x.operands))
            factor, count = max(
                counts.items(), key=lambda c: (c[1], _order(c[0])), default=(0.0, 0)
            )
            if count < 2:
                break
            group = [(k, x) for k, x in products if k not in taken and factor in x.operands]
            rest = [(terms[k][0], self._of(_cofactor(x, factor))) for k, x in group]
            taken.update(k for k, _ in group)
            done.append((False, multiply(self._of(factor), _total(rest))))
        if not taken:
            return None
        kept = [(n, self._of(x)) for k, (n, x) in enumerate(terms) if k not in taken]
        return kept + done


def _is_product(x: Scalar) -> bool:
    return x.operation is Operation.MULTIPLY


def _order(x: Operand) -> float:
    """Breaks ties always in the same way: constants first, then what was made first."""
    return -float(x.index) if isinstance(x, Scalar) else 1.0 + abs(x)


def _cofactor(product: Scalar, factor: Operand) -> Operand:
    x, y = product.operands
    return y if x is factor or x == factor else x


def _total(terms: list[_Term]) -> Operand:
    total: Operand = 0.0
    for negated, x in terms:
        total = add(total, negate(x) if negated else x)
    return total
