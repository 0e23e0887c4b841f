"""`x5-coordinator`: a robot identifies itself, and what is done with the identified model."""

from coordinator.runtime.command_line import LazyCommand, lazy_app

_FOLDER = "coordinator.commands"
COMMANDS = {
    "run": LazyCommand(f"{_FOLDER}.run", "run", "Identify a robot: topology, kinematic chain and inertia."),
    "replay": LazyCommand(f"{_FOLDER}.replay", "replay", "Compute a run's result again from its recording."),
    "list": LazyCommand(f"{_FOLDER}.list_modules", "list_modules", "List the modules on the network."),
    "stop": LazyCommand(f"{_FOLDER}.stop", "stop", "Stop every module of a robot at once."),
    "screenshot": LazyCommand(f"{_FOLDER}.screenshot", "screenshot", "Render a recording as a PNG file."),
    "check": LazyCommand(
        f"{_FOLDER}.check", "check_robot", "Find the links that changed since an earlier run."
    ),
    "payload": LazyCommand(f"{_FOLDER}.payload", "find_payload", "Measure the payload that a robot carries."),
    "merge": LazyCommand(f"{_FOLDER}.merge", "merge", "Combine runs with the same modules."),
    "monitor": LazyCommand(
        f"{_FOLDER}.monitor", "monitor_robot", "Report collisions, payloads and wear while a robot moves."
    ),
    "fit-dynamics": LazyCommand(
        f"{_FOLDER}.fit_dynamics", "fit_dynamics", "Fit the inertia of any arm from its URDF and a log."
    ),
    "compensate": LazyCommand(
        f"{_FOLDER}.compensate", "compensate_robot", "Compensate gravity, so that the robot is led by hand."
    ),
}

app = lazy_app("x5-coordinator", "Let a modular robot identify its own kinematics and dynamics.", COMMANDS)

if __name__ == "__main__":
    app()
