"""`x5-coordinator`: a robot identifies itself, and what is done with the identified model."""

from coordinator.runtime.command_line import lazy_app

COMMANDS = {
    "run": ("run.run", "Identify a robot: topology, kinematic chain and inertia."),
    "replay": ("run.replay", "Compute a run's result again from its recording."),
    "import": ("import_log.import_log", "Make a recording of a log of HEBI's programs."),
    "report": ("report.report", "Write the report of a run for people."),
    "export": ("export.export", "Write a run as a table, for ROS 2 or for Foxglove."),
    "list": ("list_modules.list_modules", "List the modules on the network."),
    "stop": ("list_modules.stop", "Stop every module of a robot at once."),
    "gains": ("before_moving.gains", "Show, load or save the modules' gains, as HEBI's files."),
    "safety": ("safety.safety", "Show or convert a file of the modules' limits."),
    "check-link": ("before_moving.check_link", "Check the network to every module."),
    "identify": ("before_moving.identify", "Light the LED of a module."),
    "keys": ("keys.keys", "Make the keys and certificates for --secure."),
    "view": ("view.view", "Show the recording of a run, on this screen or in a browser."),
    "screenshot": ("screenshot.screenshot", "Render a recording as a PNG file."),
    "check": ("measured_again.check_robot", "Find the links that changed since an earlier run."),
    "payload": ("measured_again.find_payload", "Measure the payload that a robot carries."),
    "merge": ("merge.merge", "Combine runs with the same modules."),
    "monitor": (
        "monitor.monitor_robot",
        "Show all modules in a table; report what happens to a known robot.",
    ),
    "attend": ("attend.attend", "Stay with a known robot; say what changed, and measure it again."),
    "excite": ("excite.excite", "Design the motion from which fit-dynamics learns most about any arm."),
    "fit-dynamics": ("fit_dynamics.fit_dynamics", "Fit the inertia of any arm from its URDF and a log."),
    "compensate": ("compensate.compensate_robot", "Compensate gravity, so that the robot is led by hand."),
    "follow": ("follow.follow", "Follow a motion with the identified model; compare input modes."),
}

EXAMPLES = {
    "run": "x5-coordinator run --robot my_arm --expect 4 --out runs/my_arm",
    "replay": "x5-coordinator replay runs/my_arm/session.mcap --out runs/again",
    "import": "x5-coordinator import arm.hebilog --type X5-4 --type X5-4 --out runs/logged",
    "report": "x5-coordinator report runs/my_arm --out my_arm.md",
    "export": "x5-coordinator export runs/my_arm --to ros2 --rate-hz 100 --out my_arm.mcap",
    "list": "x5-coordinator list --robot my_arm --expect 4",
    "stop": "x5-coordinator stop --robot my_arm",
    "gains": "x5-coordinator gains save gains.xml --robot my_arm",
    "safety": "x5-coordinator safety limits.xml shoulder elbow --out limits.toml",
    "check-link": "x5-coordinator check-link --robot my_arm --expect 4",
    "identify": "x5-coordinator identify shoulder --robot my_arm",
    "keys": "x5-coordinator keys shoulder elbow --robot my_arm --out keys",
    "view": "x5-coordinator view runs/my_arm --serve",
    "screenshot": "x5-coordinator screenshot runs/my_arm --out my_arm.png",
    "check": "x5-coordinator check runs/my_arm --out runs/checked",
    "payload": "x5-coordinator payload runs/my_arm --out runs/loaded",
    "merge": "x5-coordinator merge runs/monday runs/tuesday --out runs/both",
    "monitor": "x5-coordinator monitor --robot my_arm",
    "attend": "x5-coordinator attend runs/my_arm --may-move --workspace room.toml",
    "excite": "x5-coordinator excite --urdf robot.urdf --out motion.csv",
    "fit-dynamics": "x5-coordinator fit-dynamics --urdf robot.urdf --data log.csv --json fit.json",
    "compensate": "x5-coordinator compensate runs/my_arm --for 60",
    "follow": "x5-coordinator follow runs/my_arm --motion motion.csv",
}

app = lazy_app(
    "x5-coordinator",
    "Let a modular robot identify its own kinematics and dynamics.",
    "coordinator.commands",
    COMMANDS,
    EXAMPLES,
)

if __name__ == "__main__":
    app()
