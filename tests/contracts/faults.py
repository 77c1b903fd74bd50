"""Classes with one fault each."""


def broken(kind, change, method="forward"):
    """A class whose method's result is changed by a function of the result and the arguments."""
    return type(
        "Broken",
        (kind,),
        {method: lambda self, *given: change(getattr(kind, method)(self, *given), *given)},
    )


def fed(kind, change, method="forward"):
    """A class whose method is called with changed arguments."""
    return type(
        "Fed", (kind,), {method: lambda self, *given: getattr(kind, method)(self, *change(*given))}
    )


def field(name, change):
    """Changes one field of a named tuple."""
    return lambda result, *given: result._replace(**{name: change(getattr(result, name))})


def having(kind, **attributes):
    """A class with other attributes."""
    return type("Having", (kind,), attributes)
