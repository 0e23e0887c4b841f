"""`x5-sim`: the simulated world, and everything that needs it or its truth."""

from coordinator.runtime.command_line import lazy_app

COMMANDS = {
    "run": ("run.run", "Identify a simulated robot and score the result."),
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
    "watch": (
        "watch.watch",
        "Count false alarms in hours of everyday use, and what of slow changes is named.",
    ),
    "faults": ("faults.faults", "Search for faults that the system does not survive."),
    "compare-log": ("compare_log.compare_log", "Compare a real module's log with the simulated module."),
}

EXAMPLES = {
    "run": "x5-sim run a2085_04 --virtual --noise x5 --out runs/a2085_04",
    "world": "x5-sim world a2085_04 --bus runs/bus --truth runs/by-hand",
    "fleet": "x5-sim fleet --robots 2 --modules 8 --routers 1 --seconds 10",
    "robots": "x5-sim robots",
    "show": "x5-sim show arm6 --out arm6.png",
    "effects": "x5-sim effects",
    "score": "x5-sim score runs/a2085_04",
    "thesis": "x5-sim thesis --quick --only figure19,table2 --out runs/thesis",
    "monitoring": "x5-sim monitoring --robot a2085_03 --hours 0.1",
    "watch": "x5-sim watch --robot a2085_03 --hours 1 --kind friction --out runs/watch",
    "faults": "x5-sim faults --seeds 1..20 --workers 2",
    "compare-log": "x5-sim compare-log log.csv --out comparison",
}

app = lazy_app(
    "x5-sim",
    "Simulate modular robots, run the whole system on them, and score it.",
    "sim.commands",
    COMMANDS,
    EXAMPLES,
    # `robot` names a simulated robot here, not the one on the network.
    aliases={"launch": "run.launch"},
    repeated=("listen", "secure", "quiet"),
)

if __name__ == "__main__":
    app()
