"""Gains files and LEDs by the commands, over the driver of real modules."""

from module_agent.control.gains import UNLIMITED, default_gains
from module_agent.control.gains_file import read_gains, write_gains
from module_agent.model.catalogue import module_type


def test_gains_are_shown_loaded_and_saved_and_a_module_is_found_by_its_led(
    launcher, client, programs, tmp_path
) -> None:
    robot = launcher(hebi=True)
    name, serials = robot.config.robot_name, robot.config.serials
    commander = client(name, hub=True)
    robot.start_world()
    commander.meet(serials, *robot.start_agents())
    at = ("--robot", name, "--listen", robot.config.endpoint, "--expect", str(len(serials)))
    factory = default_gains(module_type("X5-4"), 4)
    # As in HEBI's own files, a limit may be none.
    free = {"min_output": -UNLIMITED, "max_output": UNLIMITED, "i_clamp": UNLIMITED}
    stiff = [factory.model_copy(update={"effort": factory.effort.model_copy(update=free)})] * len(serials)
    write_gains(tmp_path / "stiff.xml", stiff)
    assert "<max_output>inf inf</max_output>" in (tmp_path / "stiff.xml").read_text()

    loaded = programs.run("coordinator.main", "gains", "load", str(tmp_path / "stiff.xml"), *at)
    assert loaded.returncode == 0, loaded.stderr
    saved = programs.run("coordinator.main", "gains", "save", str(tmp_path / "saved.xml"), *at)
    assert saved.returncode == 0, saved.stderr
    others = [default_gains(module_type("X5-1"), 0)] * len(serials)
    assert read_gains(tmp_path / "saved.xml").applied(others) == stiff
    shown = programs.run("coordinator.main", "gains", "show", *at)
    assert shown.returncode == 0, shown.stderr
    told = shown.stdout + shown.stderr
    assert all(f"simulated/{serial}" in told for serial in serials), told

    lit = programs.run("coordinator.main", "identify", serials[0], "--for", "0.2", *at[:4])
    assert lit.returncode == 0, lit.stderr
    assert f"{serials[0]}: its LED is lit for 0.2 s" in lit.stdout + lit.stderr
    unknown = programs.run("coordinator.main", "identify", "X-1", *at[:4])
    assert unknown.returncode == 1
    assert f"there are {', '.join(sorted(serials))}" in unknown.stderr
