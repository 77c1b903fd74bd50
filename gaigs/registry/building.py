"""Calls of components with the options of a configuration."""

import inspect
from collections.abc import Callable, Container, Iterable, Mapping

from gaigs.registry.option_types import check_type
from gaigs.registry.words import listed, suggest


def call(owner: str, function: Callable, options: Mapping, /, **context):
    """Calls a function or class with options, and with those items of ``context`` that it accepts.

    Args:
        owner: Name of the function in errors.

    Raises:
        TypeError: The options are no mapping, or an option has a wrong type.
        ValueError: An option is unknown or missing, or the call fails with an unclear error.
    """
    if not isinstance(options, Mapping):
        raise TypeError(f"{owner} must be a mapping of options, got {options!r}")
    check_known(owner, function, options, context)
    named = named_parameters(function)
    takes_all = _takes_all(function)
    known = [key for key in named if key not in context]
    passed = {key: value for key, value in context.items() if takes_all or key in named}
    arguments = {**options, **passed}
    mandatory = [key for key, parameter in named.items() if parameter.default is parameter.empty]
    missing = [key for key in mandatory if key not in arguments]
    if missing:
        raise ValueError(f"{owner} needs option {listed(missing)}; it has: {listed(known)}")
    for key in options.keys() & named.keys():
        if options[key] is not named[key].default:  # `width: int = None` is a common shorthand
            check_type(f"{owner} option {key!r}", options[key], named[key].annotation)
    try:
        return function(**arguments)
    except (Exception, SystemExit) as error:
        if _is_clear(error, function):
            raise
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        advice = f"check its options: {_suspects(str(error), options)}"
        raise ValueError(f"{owner} cannot be made ({cause})\n{advice}") from error


def check_known(
    owner: str, function: Callable, options: Iterable[str], given: Container[str]
) -> None:
    """Raises a ``ValueError`` for an option that a function lacks, or that its caller sets."""
    named = named_parameters(function)
    takes_all = _takes_all(function)
    unknown = [key for key in options if key in given or not (takes_all or key in named)]
    if unknown:
        known = [key for key in named if key not in given]
        words = " or ".join(suggest(key, known) for key in unknown)
        raise ValueError(f"{owner} has no option {words}; it has: {listed(known)}")


def named_parameters(function: Callable) -> dict[str, inspect.Parameter]:
    """Parameters that accept a keyword, without ``**keywords``."""
    parameters = _signature(function).parameters.items()
    return {key: p for key, p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}


def _takes_all(function: Callable) -> bool:
    """True if a function accepts any keyword.

    A torch module without a constructor has the signature (*args, **kwargs), but accepts none.
    """
    kinds = {parameter.kind for parameter in _signature(function).parameters.values()}
    parameter = inspect.Parameter
    return parameter.VAR_KEYWORD in kinds and parameter.VAR_POSITIONAL not in kinds


def _signature(function: Callable) -> inspect.Signature:
    """The parameters of a function; annotations in quotes are evaluated where possible."""
    try:
        return inspect.signature(function, eval_str=True)
    except Exception:  # of an annotation in quotes, e.g. a name that only type checkers import
        return inspect.signature(function)


def _is_clear(error: BaseException, function: Callable) -> bool:
    """True if an error needs no advice on options.

    Messages of gaigs and of plug-ins name the option; messages of torch and Lightning do not.
    """
    if isinstance(error, ArithmeticError | MemoryError | SystemExit):
        return False
    if "tried to allocate" in str(error):  # torch's words where memory is short
        return False
    return function.__module__.partition(".")[0] not in ("lightning", "torch")


def _suspects(message: str, options: Mapping) -> str:
    """The options that a message names by key or value; otherwise the keys of all options."""
    suspects = [
        f"{key}={value}"
        for key, value in options.items()
        if key in message or (isinstance(value, str) and value in message)
    ]
    return listed(suspects or options)
