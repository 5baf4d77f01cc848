# SPDX-License-Identifier: Apache-2.0
"""Names of launch and launch_ros, which PyPI's ROS lacks: as much of them as our launch files use, to read, not to start.

A launch file is visited as launch does it: arguments get their values, namespaces are pushed, functions called. What is
not here raises: a name that a launch file imports, a keyword that it gives, a process that is executed. Attributes have
launch's own names, those that are private there as well, so that a test reads both alike.
"""

from collections.abc import Callable, Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from ament_index_python.packages import get_package_prefix, get_package_share_directory
from rclpy.validate_namespace import validate_namespace


class SubstitutionFailure(RuntimeError):
    """A text that launch cannot find."""


class LaunchContext:
    """The values of the arguments, and the namespace, as they are while a launch file is visited."""

    def __init__(self) -> None:
        self.launch_configurations: dict[str, str] = {}
        self.scopes: list[dict[str, str]] = []

    def perform_substitution(self, substitution: "Substitution") -> str:
        return substitution.perform(self)


class Substitution:
    """A text that is known when the launch file is visited."""

    def perform(self, context: LaunchContext) -> str:
        raise NotImplementedError


Texts = str | Substitution | Iterable[str | Substitution]


class TextSubstitution(Substitution):
    """A text that is known already."""

    def __init__(self, *, text: str) -> None:
        self.text = text

    def perform(self, context: LaunchContext) -> str:
        return self.text


def normalized(texts: Texts) -> list[Substitution]:
    """Make substitutions of texts, which together are one; TypeError for a number or anything else, as in launch."""
    if isinstance(texts, str):
        return [TextSubstitution(text=texts)]
    if isinstance(texts, Substitution):
        return [texts]
    return [part for text in texts for part in normalized(text)]


def performed(context: LaunchContext, texts: Iterable[Substitution]) -> str:
    return "".join(context.perform_substitution(text) for text in texts)


class LaunchConfiguration(Substitution):
    """The value of an argument."""

    def __init__(self, variable_name: str) -> None:
        self.variable_name = variable_name

    def perform(self, context: LaunchContext) -> str:
        if self.variable_name not in context.launch_configurations:
            raise SubstitutionFailure(f"launch configuration '{self.variable_name}' does not exist")
        return context.launch_configurations[self.variable_name]


class PathJoinSubstitution(Substitution):
    """A path of parts."""

    def __init__(self, substitutions: Iterable[str | Substitution]) -> None:
        self.substitutions = normalized(substitutions)

    def perform(self, context: LaunchContext) -> str:
        return str(Path(*(part.perform(context) for part in self.substitutions)))


class FindPackageShare(Substitution):
    """A package's share folder, where it is installed."""

    def __init__(self, package: str) -> None:
        self.package = package

    def perform(self, context: LaunchContext) -> str:
        return get_package_share_directory(self.package)


class ExecutableInPackage(Substitution):
    """The file of a package's executable, where it is installed."""

    def __init__(self, executable: str, package: str) -> None:
        self.executable, self.package = executable, package

    def perform(self, context: LaunchContext) -> str:
        path = Path(get_package_prefix(self.package), "lib", self.package, self.executable)
        if not path.is_file():
            raise SubstitutionFailure(f"there is no {path}")
        return str(path)


class Action:
    """A step of a launch file; it may lead to others."""

    def visit(self, context: LaunchContext) -> "Iterable[Action] | None":
        return self.execute(context)

    def execute(self, context: LaunchContext) -> "Iterable[Action] | None":
        raise NotImplementedError(f"the stand-in of launch executes no {type(self).__name__}")


class LaunchDescription:
    """The steps of a launch file."""

    def __init__(self, initial_entities: Iterable[Action]) -> None:
        self.entities = list(initial_entities)


class DeclareLaunchArgument(Action):
    """An argument; without a default it has to be given."""

    def __init__(self, name: str, *, default_value: Texts | None, description: str) -> None:
        self.name, self.description = name, description
        self.default_value = None if default_value is None else normalized(default_value)

    def execute(self, context: LaunchContext) -> None:
        if self.name in context.launch_configurations:
            return
        if self.default_value is None:
            raise RuntimeError(f'Required launch argument "{self.name}" was not provided.')
        context.launch_configurations[self.name] = performed(context, self.default_value)


class OpaqueFunction(Action):
    """A function that returns further steps."""

    def __init__(self, *, function: Callable[[LaunchContext], Iterable[Action]]) -> None:
        self.function = function

    def execute(self, context: LaunchContext) -> Iterable[Action]:
        return self.function(context)


class GroupAction(Action):
    """Steps whose namespace is their own."""

    def __init__(self, actions: Iterable[Action]) -> None:
        self.actions = actions

    def execute(self, context: LaunchContext) -> list[Action]:
        return [PushLaunchConfigurations(), *self.actions, PopLaunchConfigurations()]


class PushLaunchConfigurations(Action):
    """The beginning of a group."""

    def execute(self, context: LaunchContext) -> None:
        context.scopes.append(dict(context.launch_configurations))


class PopLaunchConfigurations(Action):
    """The end of a group: all is as it was before."""

    def execute(self, context: LaunchContext) -> None:
        context.launch_configurations = context.scopes.pop()


class PushRosNamespace(Action):
    """A namespace within the previous one, or from the root if it begins with a slash."""

    def __init__(self, namespace: Texts) -> None:
        self.namespace = normalized(namespace)

    def execute(self, context: LaunchContext) -> None:
        outer = context.launch_configurations.get("ros_namespace", "").rstrip("/")
        inner = performed(context, self.namespace)
        namespace = (inner if inner.startswith("/") else f"{outer}/{inner}").rstrip("/") or "/"
        validate_namespace(namespace)
        context.launch_configurations["ros_namespace"] = namespace


class Shutdown(Action):
    """The end of all processes."""

    def __init__(self, *, reason: str) -> None:
        self.reason = reason


class ExecuteLocal(Action):
    """A process: what launch does with its output and its end."""

    def __init__(
        self,
        *,
        output: str = "log",
        on_exit: Callable[[Any, LaunchContext], Action] | None = None,
        respawn: bool = False,
        respawn_delay: float | None = None,
    ) -> None:
        self.output = output
        self.__on_exit, self.__respawn, self.__respawn_delay = on_exit, respawn, respawn_delay


class ExecuteProcess(ExecuteLocal):
    """A process with its command line, and variables besides the environment's."""

    def __init__(
        self,
        *,
        cmd: Iterable[Texts],
        name: str | None = None,
        additional_env: Mapping[str, Texts] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.cmd, self.name = [normalized(word) for word in cmd], name
        self.additional_env = [(normalized(k), normalized(v)) for k, v in (additional_env or {}).items()]


class ParameterFile:
    """A file of parameters."""

    def __init__(self, param_file: str) -> None:
        self.param_file = normalized(param_file)


class Node(ExecuteProcess):
    """A process of ROS."""

    def __init__(
        self,
        *,
        package: str,
        executable: str,
        parameters: Iterable[str] = (),
        arguments: Iterable[Texts] = (),
        **options: Any,
    ) -> None:
        if "cmd" in options or "name" in options:
            raise TypeError("the stand-in of launch makes a node's command line, and gives it no name")
        file = ExecutableInPackage(executable, package)
        super().__init__(cmd=[file, *arguments, "--ros-args"], **options)
        self.node_package, self.node_executable = package, executable
        self.__parameters = [ParameterFile(path) for path in parameters]


CONTENT: dict[str, tuple[type, ...]] = {
    "launch": (LaunchContext, LaunchDescription),
    "launch.actions": (DeclareLaunchArgument, ExecuteProcess, GroupAction, OpaqueFunction, Shutdown),
    "launch.substitutions": (LaunchConfiguration, PathJoinSubstitution),
    "launch_ros": (),
    "launch_ros.actions": (Node, PushRosNamespace),
    "launch_ros.substitutions": (ExecutableInPackage, FindPackageShare),
}


def modules() -> dict[str, ModuleType]:
    """Make modules for sys.modules that let this process read launch files: none where launch_ros is installed."""
    if find_spec("launch_ros"):
        return {}
    made = {name: ModuleType(name) for name in CONTENT}
    for name, members in CONTENT.items():
        vars(made[name]).update({member.__name__: member for member in members})
    return made
