"""Mutants of a module: its source with one comparison, operator, number or truth value changed."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass

__all__ = ["Mutant", "mutants_of"]

# What each comparison is changed to: the limit itself falls on the other side; all falls there.
COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
# Whole numbers from here on are changed by a tenth, smaller ones by one.
LARGE_WHOLE = 10


@dataclass(frozen=True)
class Mutant:
    """One change of a source.

    Attributes:
        line: where, from 1.
        where: qualified name of the function or class; empty at the module's top.
        change: what was changed to what, as source.
        source: the whole module with that change.
    """

    line: int
    where: str
    change: str
    source: str

    @property
    def key(self) -> tuple[str, str]:
        """What names it, whatever line it stands on."""
        return self.where, self.change


def mutants_of(source: str) -> tuple[Mutant, ...]:
    """Return every mutant of a source.

    Changed are: comparisons; ``and`` and ``or``; ``not``, also put before a condition that has
    none; numbers, by a tenth or by one; ``True`` and ``False``; and what a function that is said
    to return ``bool`` returns. Annotations, decorators, texts and ``__all__`` stay.
    """
    tree = ast.parse(source)
    return tuple(_Walk(tree).mutants())


class _Walk:
    """Walks over a tree, changes it in place, writes it out and changes it back."""

    def __init__(self, tree: ast.Module) -> None:
        self.tree = tree

    def mutants(self) -> Iterator[Mutant]:
        """Yield the mutants in the order of the source."""
        yield from self._body(self.tree.body, "", is_predicate=False)

    def _body(self, body: list[ast.stmt], where: str, *, is_predicate: bool) -> Iterator[Mutant]:
        for statement in body:
            yield from self._statement(statement, where, is_predicate=is_predicate)

    def _statement(
        self, statement: ast.stmt, where: str, *, is_predicate: bool
    ) -> Iterator[Mutant]:
        if isinstance(statement, ast.FunctionDef | ast.ClassDef):
            yield from self._definition(statement, where)
            return
        if isinstance(statement, ast.If | ast.While):
            yield from self._condition(statement, where)
        if isinstance(statement, ast.Return) and is_predicate:
            yield from self._answers(statement, where)
        for child in ast.iter_child_nodes(statement):
            if isinstance(child, ast.stmt):
                yield from self._statement(child, where, is_predicate=is_predicate)
            elif isinstance(child, ast.expr):
                if not (isinstance(statement, ast.AnnAssign) and child is statement.annotation):
                    shown = child if hasattr(statement, "body") else statement
                    yield from self._expression(child, shown, where)
            else:
                yield from self._other(child, where, is_predicate=is_predicate)

    def _definition(
        self, statement: ast.FunctionDef | ast.ClassDef, where: str
    ) -> Iterator[Mutant]:
        """Go into a function or a class, past its decorators and annotations."""
        name = f"{where}.{statement.name}" if where else statement.name
        is_predicate = False
        if isinstance(statement, ast.FunctionDef):
            for default in (*statement.args.defaults, *statement.args.kw_defaults):
                if default is not None:
                    yield from self._expression(default, default, name)
            returns = statement.returns
            is_predicate = isinstance(returns, ast.Name) and returns.id == "bool"
        yield from self._body(statement.body, name, is_predicate=is_predicate)

    def _other(self, node: ast.AST, where: str, *, is_predicate: bool) -> Iterator[Mutant]:
        """Go into what is neither: ``except`` clauses, items of ``with``."""
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.stmt):
                yield from self._statement(child, where, is_predicate=is_predicate)
            elif isinstance(child, ast.expr) and not isinstance(node, ast.ExceptHandler):
                yield from self._expression(child, child, where)

    def _condition(self, statement: ast.If | ast.While, where: str) -> Iterator[Mutant]:
        """Turn round a condition that no other change turns round."""
        test = statement.test
        if not isinstance(test, ast.Compare | ast.UnaryOp):
            yield self._swap(statement, "test", ast.UnaryOp(ast.Not(), test), test, where)

    def _answers(self, statement: ast.Return, where: str) -> Iterator[Mutant]:
        value = statement.value
        if value is not None and not isinstance(value, ast.Constant):
            for answer in (True, False):
                yield self._swap(statement, "value", ast.Constant(answer), statement, where)

    def _expression(self, node: ast.expr, shown: ast.AST, where: str) -> Iterator[Mutant]:
        """Yield the mutants of an expression; ``shown`` is what a number in it is shown within."""
        if isinstance(node, ast.Compare):
            for index, operator in enumerate(node.ops):
                for other in COMPARISONS[type(operator)]:
                    yield self._item(node.ops, index, other(), node, where)
        elif isinstance(node, ast.BoolOp):
            joined = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield self._swap(node, "op", joined, node, where)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            yield from self._without_not(node, where)
        elif isinstance(node, ast.IfExp) and not isinstance(node.test, ast.Compare | ast.UnaryOp):
            yield self._swap(node, "test", ast.UnaryOp(ast.Not(), node.test), node, where)
        elif isinstance(node, ast.Constant):
            for value in _other_values(node.value):
                yield self._swap(node, "value", value, shown, where)
        for child in ast.iter_child_nodes(node):
            yield from self._inside(child, shown, where)

    def _inside(self, node: ast.AST, shown: ast.AST, where: str) -> Iterator[Mutant]:
        if isinstance(node, ast.expr):
            is_shown = isinstance(node, ast.Compare | ast.Call | ast.BinOp)
            yield from self._expression(node, node if is_shown else shown, where)
        elif isinstance(node, ast.keyword | ast.comprehension):
            for child in ast.iter_child_nodes(node):
                yield from self._inside(child, shown, where)

    def _without_not(self, node: ast.UnaryOp, where: str) -> Iterator[Mutant]:
        # ``not not x`` is as true as ``x``: the tree need not know who holds the node.
        yield self._swap(node, "operand", ast.UnaryOp(ast.Not(), node.operand), node, where)

    def _swap(self, node: ast.AST, field: str, other: object, shown: ast.AST, where: str) -> Mutant:
        """Return the mutant in which a field of a node is another."""
        old = getattr(node, field)

        def put(value: object) -> None:
            setattr(node, field, value)

        # A condition is shown by itself, and the new one in its place.
        after = other if field == "test" and isinstance(node, ast.stmt) else shown
        return self._mutant(put, old, other, node, (shown, after), where)

    def _item(
        self, items: list[ast.cmpop], index: int, other: ast.cmpop, node: ast.AST, where: str
    ) -> Mutant:
        def put(value: object) -> None:
            assert isinstance(value, ast.cmpop)
            items[index] = value

        return self._mutant(put, items[index], other, node, (node, node), where)

    def _mutant(
        self,
        put: Callable[[object], None],
        old: object,
        new: object,
        node: ast.AST,
        shown: tuple[ast.AST, object],
        where: str,
    ) -> Mutant:
        before = _text(shown[0])
        put(new)
        after, source = _text(shown[1]), ast.unparse(ast.fix_missing_locations(self.tree))
        put(old)
        line = getattr(node, "lineno", 0)
        return Mutant(line, where, f"{before} => {after}", source)


def _text(node: object) -> str:
    assert isinstance(node, ast.AST)
    return " ".join(ast.unparse(node).split())


def _other_values(value: object) -> tuple[object, ...]:
    """Return what a number or a truth value is changed to."""
    if isinstance(value, bool):
        return (not value,)
    if isinstance(value, int):
        step = 1 if abs(value) < LARGE_WHOLE else max(1, round(0.1 * abs(value)))
        return value + step, value - step
    if isinstance(value, float):
        return (1.1 * value, 0.9 * value) if value else (0.1,)
    return ()
