"""`x5-coordinator`: a robot identifies itself, and what is done with the identified model."""

from coordinator.runtime.command_line import lazy_app

COMMANDS = {
    "run": ("run.run", "Identify a robot: topology, kinematic chain and inertia."),
    "replay": ("run.replay", "Compute a run's result again from its recording."),
    "report": ("report.report", "Write the report of a run for people."),
    "export": ("export.export", "Write a run as a table, for ROS 2 or for Foxglove."),
    "list": ("list_modules.list_modules", "List the modules on the network."),
    "stop": ("list_modules.stop", "Stop every module of a robot at once."),
    "keys": ("keys.keys", "Make the keys and certificates for --secure."),
    "view": ("view.view", "Show the recording of a run, on this screen or in a browser."),
    "screenshot": ("screenshot.screenshot", "Render a recording as a PNG file."),
    "check": ("measured_again.check_robot", "Find the links that changed since an earlier run."),
    "payload": ("measured_again.find_payload", "Measure the payload that a robot carries."),
    "merge": ("merge.merge", "Combine runs with the same modules."),
    "monitor": ("monitor.monitor_robot", "Report collisions, payloads and wear while a robot moves."),
    "excite": ("excite.excite", "Design the motion from which fit-dynamics learns most about any arm."),
    "fit-dynamics": ("fit_dynamics.fit_dynamics", "Fit the inertia of any arm from its URDF and a log."),
    "compensate": ("compensate.compensate_robot", "Compensate gravity, so that the robot is led by hand."),
    "follow": ("follow.follow", "Follow a motion with the identified model; compare input modes."),
}

app = lazy_app(
    "x5-coordinator",
    "Let a modular robot identify its own kinematics and dynamics.",
    "coordinator.commands",
    COMMANDS,
)

if __name__ == "__main__":
    app()
