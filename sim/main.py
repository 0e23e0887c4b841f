"""`x5-sim`: the simulated world, and everything that needs it or its truth."""

from coordinator.runtime.command_line import LazyCommand, lazy_app

_FOLDER = "sim.commands"
COMMANDS = {
    "run": LazyCommand(f"{_FOLDER}.run", "run", "Identify a simulated robot and score the result."),
    "launch": LazyCommand(
        f"{_FOLDER}.run", "launch", "Run world, agents and coordinator with the live viewer."
    ),
    "world": LazyCommand(f"{_FOLDER}.world", "world", "Run the world of one robot for agents to attach to."),
    "compile": LazyCommand(
        f"{_FOLDER}.compile", "compile_kernels", "Compile all kernels, so that the first run does not."
    ),
    "robots": LazyCommand(f"{_FOLDER}.robots", "robots", "List the robots that are shipped."),
    "show": LazyCommand(f"{_FOLDER}.robots", "show", "Draw a robot at its zero position."),
    "effects": LazyCommand(
        f"{_FOLDER}.effects_page", "effects", "List the imperfections of a simulated module."
    ),
    "score": LazyCommand(
        f"{_FOLDER}.score", "score_run", "Compare a run's result with the simulator's truth."
    ),
    "benchmark": LazyCommand(f"{_FOLDER}.benchmark", "app", "Measure the whole system against its bars."),
    "amplitudes": LazyCommand(
        f"{_FOLDER}.amplitudes", "amplitudes", "Repeat the thesis' estimates of link length over amplitudes."
    ),
    "estimators": LazyCommand(
        f"{_FOLDER}.estimators", "estimators", "Compare estimators of a joint's radial distance."
    ),
    "assistance": LazyCommand(
        f"{_FOLDER}.assistance", "assistance", "Measure tracking errors with and without feed-forward torque."
    ),
    "monitoring": LazyCommand(
        f"{_FOLDER}.monitoring", "monitoring", "Count what the monitor finds, and its false alarms."
    ),
    "compare-log": LazyCommand(
        f"{_FOLDER}.compare_log", "compare_log", "Compare a real module's log with the simulated module."
    ),
}

app = lazy_app("x5-sim", "Simulate modular robots, run the whole system on them, and score it.", COMMANDS)

if __name__ == "__main__":
    app()
