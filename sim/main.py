"""`x5-sim`: the simulated world, and everything that needs it or its truth."""

from coordinator.runtime.command_line import lazy_app

COMMANDS = {
    "run": ("run.run", "Identify a simulated robot and score the result."),
    "launch": ("run.launch", "Run world, agents and coordinator with the live viewer."),
    "world": ("world.world", "Run the world of one robot for agents to attach to."),
    "fleet": ("fleet.fleet", "Run several robots on Zenoh routers, and measure what they cost."),
    "compile": ("compile.compile_kernels", "Compile all kernels, so that the first run does not."),
    "robots": ("robots.robots", "List the robots that are shipped."),
    "show": ("robots.show", "Draw a robot at its zero position."),
    "effects": ("effects_page.effects", "List the imperfections of a simulated module."),
    "score": ("score.score_run", "Compare a run's result with the simulator's truth."),
    "benchmark": ("benchmark.app", "Measure the whole system against its bars."),
    "thesis": ("thesis.thesis", "Repeat the thesis' experiments and compare with what it printed."),
    "monitoring": ("monitoring.monitoring", "Count what the monitor finds, and its false alarms."),
    "faults": ("faults.faults", "Search for faults that the system does not survive."),
    "compare-log": ("compare_log.compare_log", "Compare a real module's log with the simulated module."),
}

app = lazy_app(
    "x5-sim",
    "Simulate modular robots, run the whole system on them, and score it.",
    "sim.commands",
    COMMANDS,
)

if __name__ == "__main__":
    app()
