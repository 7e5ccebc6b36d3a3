"""Checks of PromQL expressions against the existing series."""

import promql_parser as promql

from tests.deploy.series import Labels, Series, is_known

_NONE: Labels = {}


class QueryError(ValueError):
    """A query selects a metric, label or value that does not exist."""


def labels_of(query: str, series: Series) -> Labels:
    """Return the labels of a query's result, with their possible values.

    Args:
        query: PromQL.
        series: all existing series.

    Raises:
        QueryError: the query selects another metric, label or value.
        ValueError: the query cannot be parsed.
    """
    return _labels(promql.parse(query), series)


def _labels(expr: promql.Expr, series: Series) -> Labels:
    match expr:
        case promql.NumberLiteral() | promql.StringLiteral():
            found = _NONE
        case promql.VectorSelector():
            found = _selected(expr, series)
        case promql.MatrixSelector():
            found = _selected(expr.vector_selector, series)
        case promql.ParenExpr() | promql.UnaryExpr() | promql.SubqueryExpr():
            found = _labels(expr.expr, series)
        case promql.Call():
            found = _called(expr, series)
        case promql.AggregateExpr():
            found = _aggregated(expr, series)
        case promql.BinaryExpr():
            found = _joined(expr, series)
        case _:
            raise QueryError(f"nothing is known of {expr.prettify()}")
    return found


def _selected(selector: promql.VectorSelector, series: Series) -> Labels:
    name = selector.name
    if name is None or name not in series:
        raise QueryError(f"there is no metric {name}")
    labels = series[name]
    for matcher in selector.matchers.matchers:
        _require([matcher.name], labels, selector)
        if not matcher.value.startswith("$") and not is_known(matcher.value, labels, matcher.name):
            raise QueryError(f"{matcher.name} of {name} is never {matcher.value}")
    return labels


def _called(call: promql.Call, series: Series) -> Labels:
    merged: Labels = {}
    for argument in call.args:
        merged |= _labels(argument, series)
    if call.func.name == "histogram_quantile":
        _require(["le"], merged, call)
        return {name: values for name, values in merged.items() if name != "le"}
    return merged


def _aggregated(expr: promql.AggregateExpr, series: Series) -> Labels:
    inner = _labels(expr.expr, series)
    if expr.modifier is None:
        return _NONE
    _require(expr.modifier.labels, inner, expr)
    by = expr.modifier.type == promql.AggModifierType.By
    return {name: values for name, values in inner.items() if (name in expr.modifier.labels) == by}


def _joined(expr: promql.BinaryExpr, series: Series) -> Labels:
    left, right = _labels(expr.lhs, series), _labels(expr.rhs, series)
    if isinstance(expr.lhs, promql.NumberLiteral):
        return right
    modifier = expr.modifier
    if modifier is None or modifier.matching is None:
        return left
    _require(modifier.matching.labels, left, expr)
    _require(modifier.matching.labels, right, expr)
    added = modifier.group_labels or []
    _require(added, right, expr)
    return left | {name: right[name] for name in added}


def _require(names: list[str], labels: Labels, expr: promql.Expr) -> None:
    for name in names:
        if name not in labels:
            raise QueryError(f"there is no label {name}: {expr.prettify()}")
