"""`derived` of a part's identity: the operation, the parts that it was made from, and the settings."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from pydantic import ValidationError

from tcmrl_data.foundation.canonical import canonical_json
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.records import Record, first_problem

Settings = TypeVar("Settings", bound=Record)


def derived_fields(operation: str, sources: Sequence[str], settings: Record) -> dict[str, Any]:
    """What the identity of a derived part says of how it was made.

    Args:
        operation: such as `extend`.
        sources: ids of the parts that it was made from.
        settings: of the operation.
    """
    return {"operation": operation, "from": list(sources), "settings": settings.model_dump(mode="json")}


def read_settings(kind: type[Settings], derived: Mapping[str, Any], place: str) -> Settings:
    """The settings of a derived part.

    Raises:
        ManifestError: they are not valid; the message names the place and the field.
    """
    try:
        return kind.model_validate_json(canonical_json(derived.get("settings")))
    except ValidationError as error:
        raise ManifestError(f"{place}: identity.derived.settings: {first_problem(error)}") from None
