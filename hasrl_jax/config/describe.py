"""What the fields of a configuration mean, read from the comments beside them."""

import inspect
import re

_FIELD = re.compile(r"    (?P<name>\w+): .*?(?:  # (?P<beside>.*))?$")


def descriptions(settings: type) -> dict[str, str]:
    """The comment beside or above each field, by name, with those of its base classes; fields without one are left out.

    A class that was made on the way, as `tasks.config_class` does, has no source of its own.
    """
    found: dict[str, str] = {}
    for base in reversed(settings.__mro__):
        try:
            lines = inspect.getsource(base).splitlines()
        except (OSError, TypeError):
            continue
        above = ""
        for line in lines:
            field = _FIELD.match(line)
            if field and (field["beside"] or above):
                found[field["name"]] = field["beside"] or above
            comment = line.strip().removeprefix("# ") if line.startswith("    # ") else ""
            above = f"{above} {comment}".strip() if comment else ""
    return found
