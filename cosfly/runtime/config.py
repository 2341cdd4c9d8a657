"""Settings: YAML and `--set a.b=c` into strict pydantic models, with all problems reported at once.

Settings are YAML with the values of JSON, comments and anchors. A tag, a repeated key and a key that is not text or a
number are errors; a date is text.
"""

import copy
from collections.abc import Iterable, Iterator
from inspect import get_annotations
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError
from pydantic_core import to_jsonable_python

from cosfly.runtime.errors import ConfigError, InputError, json_type, nearest, plain, shown
from cosfly.runtime.io import read_text

MOST_BYTES = 1_000_000  # the settings of a run take some 10 kB, the longest shipped word list 100 kB
MOST_LISTED = 15  # names of settings in a message
MOST_ELSEWHERE = 3  # settings in other groups in a message, as in "did you mean plan.x or render.x"
MOST_PARTS = 32  # of the name of a setting
MOST_PROBLEM = 400  # characters of the parser's message, which quotes the text

T = TypeVar("T")
C = TypeVar("C", bound=BaseModel)

# MayDiffer[int] is a setting that changes how a stage works but not its products: it is not recorded in `stage.json`,
# and a stage may be resumed with another value.
_MAY_DIFFER = "may differ on resume"
MayDiffer = Annotated[T, _MAY_DIFFER]
# IfChanged[int] is recorded only if it is not the default, so that products made without the setting stay the same.
_IF_CHANGED = "recorded if changed"
IfChanged = Annotated[T, _IF_CHANGED]


def _each_once(values: tuple[T, ...]) -> tuple[T, ...]:
    if len(set(values)) < len(values):
        raise ValueError("each entry may be listed only once")
    return values


Distinct = Annotated[T, AfterValidator(_each_once)]  # Distinct[tuple[str, ...]] may not list an entry twice


class Config(BaseModel):
    """Base of every stage's settings: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def recorded(self) -> dict[str, Any]:
        """Return the settings and constants that determine the products, JSON-able.

        These are all but those of MayDiffer, and those of IfChanged that have the default.
        """
        skipped = {
            name
            for name, field in type(self).model_fields.items()
            if _MAY_DIFFER in field.metadata or (_IF_CHANGED in field.metadata and getattr(self, name) == field.default)
        }
        return self._values("recorded", [name for name in self._names() if name not in skipped])

    def all_values(self) -> dict[str, Any]:
        """Return all settings and constants, JSON-able."""
        return self._values("all_values", self._names())

    def _values(self, method: str, names: list[str]) -> dict[str, Any]:
        values = {name: getattr(self, name) for name in names}
        groups = {name: getattr(value, method)() for name, value in values.items() if isinstance(value, Config)}
        return to_jsonable_python(values) | groups

    @classmethod
    def _names(cls) -> list[str]:
        """Return the names of settings and constants (ClassVar) in the order of their declaration."""
        names = (name for base in reversed(cls.__mro__) if issubclass(base, Config) for name in get_annotations(base))
        return [name for name in dict.fromkeys(names) if name in cls.model_fields or name in cls.__class_vars__]


# --- YAML -------------------------------------------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """The safe loader; it refuses a key that occurs twice."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        seen = set[str]()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(problem="a key is not text or a number", problem_mark=key.start_mark)
            if key.value in seen and key.value != "<<":
                raise yaml.MarkedYAMLError(problem=f"the key {key.value!r} is given twice", problem_mark=key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: Any) -> int:
        number = super().construct_yaml_int(node)
        float(number)  # an OverflowError for a number that JSON and messages cannot hold either
        return number


# Only the types of JSON; without the resolver a date stays text.
_KINDS = {f"tag:yaml.org,2002:{kind}" for kind in ("null", "bool", "int", "float", "str", "seq", "map", "merge")}
_Loader.yaml_constructors = {
    tag: constructor for tag, constructor in yaml.SafeLoader.yaml_constructors.items() if tag is None or tag in _KINDS
}
_Loader.yaml_constructors["tag:yaml.org,2002:int"] = _Loader.construct_yaml_int
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag in _KINDS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parse_yaml(text: str, where: str | Path, *, what: str = "configuration") -> Any:
    """Return the value of YAML text; ConfigError if it is invalid or too long."""
    if len(text) > MOST_BYTES:
        expected = f"at most {MOST_BYTES / 1e6:g} MB"
        raise ConfigError(f"the {what} is too long", where=where, got=f"{len(text) / 1e6:.1f} MB", expected=expected)
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, ArithmeticError, RecursionError) as error:
        raise ConfigError(f"the {what} is not valid YAML", where=where, got=str(error)[:MOST_PROBLEM]) from None


def read_yaml(path: Path) -> dict:
    """Read a YAML mapping; ConfigError if the file holds something else."""
    try:
        text = read_text(path, what="configuration")
    except InputError as error:
        raise ConfigError(error.what, where=path, got=error.got, fix=error.fix) from None
    value = parse_yaml(text, path)
    if not isinstance(value, dict | None):
        what = "the configuration is not a mapping of settings"
        raise ConfigError(what, where=path, got=json_type(value), expected="lines such as `seed: 3`")
    return value or {}


# --- from settings to models ------------------------------------------------------------------------------------------


def apply_overrides(data: dict, overrides: Iterable[str]) -> dict:
    """Return a copy of `data` with `a.b=c` assignments applied; values are read as YAML."""
    data = copy.deepcopy(data)
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not all(key.split(".")) or key.count(".") > MOST_PARTS:
            expected = "`key=value`, for instance `pedestrians.num_paths=3`"
            raise ConfigError("the value of --set is not an assignment", got=override[:80], expected=expected)
        value = parse_yaml(text, f"--set {key}", what="value")
        node = data
        *parents, last = key.split(".")
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise ConfigError(f"{parent!r} is not a group of settings", where=f"--set {key}")
        node[last] = value
    return data


def build(model: type[C], data: dict, source: str | Path) -> C:
    """Return a model of plain data; ConfigError lists all problems, and the nearest name for each unknown key."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError.of_all([_problem(model, detail) for detail in error.errors()], where=source) from None


def load(model: type[C], path: Path | None, overrides: Iterable[str] = ()) -> C:
    """Return a model of the defaults, then the file, then the overrides."""
    overrides = list(overrides)
    data = apply_overrides(read_yaml(path) if path else {}, overrides)
    return build(model, data, source_text(path, bool(overrides)))


def source_text(path: Path | None, has_overrides: bool) -> str:
    """Return the sources of settings for messages: `run.yaml with --set`."""
    sources = [str(path)] if path else []
    if has_overrides:
        sources.append("--set")
    return " with ".join(sources)


def _problem(model: type[BaseModel], detail: Any) -> str:
    """Return one error of pydantic in our words."""
    field = ".".join(str(part) for part in detail["loc"]) or "settings"
    kind = detail["type"]
    if kind == "extra_forbidden":
        *parents, last = detail["loc"]
        names = list(getattr(_group(model, parents), "model_fields", {}))
        elsewhere = [name for name in _names(model) if f".{name}".endswith(f".{last}")]
        if 0 < len(elsewhere) <= MOST_ELSEWHERE:
            return f"{field}: unknown setting (did you mean {' or '.join(map(repr, elsewhere))}?)"
        hint = nearest(str(last), names)
        if not hint and len(names) <= MOST_LISTED:
            hint = f" (the settings here are {', '.join(names)})"
        return f"{field}: unknown setting{hint}"
    if kind in ("list_type", "tuple_type"):
        return f"{field}: the value is not a list, got {shown(detail['input'])}; write [{detail['input']}]"
    message = "the value is not a group of settings" if kind == "model_type" else plain(detail["msg"])
    got = "" if isinstance(detail["input"], dict) else f", got {shown(detail['input'])}"
    return f"{field}: {message}{got}"


def _names(model: Any, above: str = "") -> Iterator[str]:
    """Yield the names of all settings and groups of a model, as `--set` takes them."""
    for field in getattr(model, "model_fields", {}):
        yield above + field
        yield from _names(_group(model, [field]), f"{above}{field}.")


def _group(model: Any, parents: Iterable[Any]) -> Any:
    """Return the model of the group of settings at `parents`; None if there is none."""
    for parent in parents:
        field = getattr(model, "model_fields", {}).get(parent)
        if field is None:
            continue  # the tag of a union, or a position in a list
        kinds = [field.annotation, *get_args(field.annotation)]
        model = next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), None)
    return model


# --- files of settings ------------------------------------------------------------------------------------------------


def shipped(name: str) -> Path:
    """Return the path of a file that ships in `configs/`, which is a link to the folder of the repository."""
    return Path(__file__).parents[1] / "configs" / name


def config_file(config: Path | None) -> Path | None:
    """Return the file of a configuration: a path, a run directory, or the name of a shipped one."""
    if config is None or config.is_file():
        return config
    if (config / "run.yaml").is_file():
        return config / "run.yaml"
    is_bare = config.suffix == "" and len(config.parts) == 1
    if is_bare and (packaged := shipped(f"{config}.yaml")).exists():
        return packaged  # even where a folder has this name
    names = sorted(path.stem for path in shipped(".").glob("*.yaml") if path.stem != "glossary")
    expected = f"a YAML file, a run directory, or one of {', '.join(names)}"
    if config.is_dir():
        got = "no run.yaml in it"
        raise ConfigError("this folder is not a run directory", where=config, got=got, expected=expected)
    if is_bare:
        what = f"there is no configuration of this name{nearest(str(config), names)}"
        raise ConfigError(what, where=config, expected=expected)
    return config
