"""Services and parameters, called as rmw_cyclonedds calls them."""

import csv
import json
import runpy
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import messages as ros
from robot import (
    RELIABLE,
    Program,
    Robot,
    ended,
    given,
    matched,
    odograph,
    os,
    play,
    poses,
    stamp_ns,
    until,
)

TRIGGERS = ["start", "stop", "mark", "localize", "save"]


def triggers(robot):
    return [robot.client(f"/odograph/{name}", "Trigger") for name in TRIGGERS]


def value(kind, what):
    fields = [kind, False, 0, 0.0, "", [], [], [], [], []]
    fields[kind] = what
    return ros.ParameterValue(*fields)


def test_a_run_is_started_marked_saved_and_stopped(simulated, recording, robot, tmp_path):
    odometry = robot.listen("/odom", ros.Odometry)
    images = robot.writer("/camera/image_raw", ros.Image)
    program = Program(
        tmp_path, f"live ros2:/camera/image_raw {given(simulated)} --ros2 --ros2-wait -o live"
    )
    start, stop, mark, localize, save = triggers(robot)
    until(lambda: matched(images), what="the subscription")
    # Nothing is tracked and nothing written before the start.
    play(recording, lambda number: images.write(recording.image(number)), numbers=range(20))
    for service in [stop, mark, localize, save]:
        reply = service()
        assert not reply.success and reply.message == "the run waits for its start: call /odograph/start"
    assert not odometry and not (tmp_path / "live").exists()
    reply = start()
    assert (reply.success, reply.message) == (True, "the run begins")
    playing = threading.Thread(
        target=play,
        args=(recording, lambda number: images.write(recording.image(number))),
        kwargs={"numbers": range(20, 181)},
    )
    playing.start()
    until(lambda: len(odometry) > 30, what="the odometry")
    # Images of before the start are not part of the run.
    assert stamp_ns(odometry[0][1]) >= recording.time_ns(20)
    reply = start()
    assert not reply.success and "has begun already" in reply.message
    reply = localize()
    assert reply.success and reply.message.startswith("camera in map: x "), reply.message
    reply = mark()
    assert reply.success and reply.message.startswith('mark "1" at x '), reply.message
    until(lambda: len(odometry) > 90, what="more odometry")
    reply = save(seconds=30)
    assert reply.success and reply.message.endswith("live/map-saved-1.gpkg"), reply.message
    playing.join()
    reply = save(seconds=30)
    assert reply.success and reply.message.endswith("live/map-saved-2.gpkg"), reply.message
    last = recording.time_ns(180)
    until(lambda: stamp_ns(odometry[-1][1]) == last, what="the last odometry")
    x_m = odometry[-1][1].pose.pose.position.x
    reply = localize()
    assert abs(float(reply.message.split()[4]) - x_m) < 0.02, (reply.message, x_m)
    reply = stop()
    assert reply.success and reply.message == "the run ends; its results will be in live", reply.message
    code, said = program.end()
    assert code == 0, said
    assert len(poses(tmp_path / "live/trajectory.csv")) > 150
    with open(tmp_path / "live/marks.csv", encoding="utf-8") as file:
        assert [row["name"] for row in csv.DictReader(file)] == ["1"]
    # What was saved is a map like the one at the end, and nothing is left beside it.
    keyframes = []
    for name in ["map-saved-1.gpkg", "map-saved-2.gpkg", "map.gpkg"]:
        command = [os.environ["ODOGRAPH"], "map", "info", f"live/{name}", "--json"]
        info = json.loads(subprocess.run(command, cwd=tmp_path, check=True, capture_output=True).stdout)
        keyframes.append(info["keyframes"])
    assert 0 < keyframes[0] < keyframes[1] <= keyframes[2], keyframes
    odograph(tmp_path, "map mosaic live/map-saved-2.gpkg -q")
    odograph(tmp_path, "map export live/map-saved-2.gpkg -o grid.yaml -q")
    assert not [path for path in (tmp_path / "live").iterdir() if path.name.endswith((".part", ".lock"))]


def test_a_program_that_waits_for_its_start_can_be_interrupted(simulated, robot, tmp_path):
    sim = f"{simulated}/sim"
    live = f"live {sim}/sim.y4m --realtime {given(simulated)} --ros2 --ros2-wait -o live"
    program = Program(tmp_path, live)
    start = robot.client("/odograph/start", "Trigger")
    until(start.is_there, what="the service")
    time.sleep(2.5)
    program.interrupt()
    code, said = program.end(5)
    assert code == 130 and said.startswith("note: waiting for the service /odograph/start\n"), said
    assert not (tmp_path / "live").exists()
    code, said = Program(tmp_path, f"live {sim}/sim.y4m {given(simulated)} --ros2-wait").end(5)
    assert code == 2 and "--ros2" in said, said


def test_a_lost_camera_and_an_unknown_map_are_not_localized(simulated, recording, robot, tmp_path):
    odograph(tmp_path, "simulate -o other --format y4m --size 320x240 --seed 77 --duration 2 -q")
    odograph(tmp_path, f"run other/sim.y4m {given(simulated)} -o other-run -q")
    odometry = robot.listen("/odom", ros.Odometry)
    images = robot.writer("/camera/image_raw", ros.Image)
    program = Program(
        tmp_path,
        f"live ros2:/camera/image_raw {given(simulated)} --ros2 --map other-run/map.gpkg -o live",
    )
    localize, mark = (robot.client(f"/odograph/{name}", "Trigger") for name in ["localize", "mark"])
    until(lambda: matched(images), what="the subscription")
    play(recording, lambda number: images.write(recording.image(number)), numbers=range(60))
    until(lambda: odometry, what="the odometry")
    reply = localize()
    assert (reply.success, reply.message) == (
        False,
        "the ground is not recognised yet in other-run/map.gpkg",
    )

    def dark(number):
        message = recording.image(number)
        message.data = bytes(len(message.data))
        images.write(message)

    play(recording, dark, numbers=range(60, 90))
    until(lambda: localize().message == "the camera is lost:dark", what="the loss")
    reply = mark()
    assert reply.success and reply.message == 'mark "1" at an unknown place: the camera is lost'
    program.interrupt()
    code, said = program.end()
    assert code == 0, said


def test_parameters_are_as_ros_expects_them(simulated, recording, robot, tmp_path):
    odometry = robot.listen("/odom", ros.Odometry)
    transforms = robot.listen("/tf", ros.TFMessage)
    events = robot.listen("/parameter_events", ros.ParameterEvent, RELIABLE)
    images = robot.writer("/camera/image_raw", ros.Image)
    program = Program(tmp_path, f"live ros2:/camera/image_raw {given(simulated)} --ros2 -o live")
    names = ["Get", "GetParameterTypes", "Set", "SetParametersAtomically", "List", "Describe"]
    kinds = [name if "Parameter" in name else f"{name}Parameters" for name in names]
    services = ["get_parameters", "get_parameter_types", "set_parameters", "set_parameters_atomically"]
    services += ["list_parameters", "describe_parameters"]
    get, types, change, change_all, show, describe = (
        robot.client(f"/odograph/{name}", kind) for name, kind in zip(services, kinds)
    )
    mark = robot.client("/odograph/mark", "Trigger")
    until(lambda: matched(images), what="the subscription")
    play(recording, lambda number: images.write(recording.image(number)), numbers=range(60))
    until(lambda: odometry, what="the odometry")
    listed = show([], 0).result.names
    expected = ["camera_frame", "height", "map", "map_frame", "mark_name", "odom_frame", "output"]
    assert listed == [*expected, "publish_map_tf", "publish_odom_tf", "source", "use_sim_time"]
    assert show(["height"], 0).result.names == ["height"]
    values = get(["height", "camera_frame", "source", "publish_map_tf", "nothing"]).values
    assert [v.type for v in values] == [3, 4, 4, 1, 0]
    assert types(["height", "nothing"]).types == [3, 0]
    assert abs(values[0].double_value - 0.9) < 1e-9
    assert [v.string_value for v in values[1:3]] == ["camera_optical", "ros2:/camera/image_raw"]
    described = describe(["height", "mark_name"]).descriptors
    assert [(d.name, d.type, d.read_only) for d in described] == [
        ("height", 3, True),
        ("mark_name", 4, False),
    ]
    assert "metres" in described[0].description
    # Each is changed or refused by itself, with the reason.
    results = change(
        [
            ros.Parameter("height", value(3, 1.5)),
            ros.Parameter("mark_name", value(4, "dock")),
            ros.Parameter("publish_map_tf", value(2, 1)),
            ros.Parameter("nothing", value(1, True)),
        ]
    ).results
    assert [r.successful for r in results] == [False, True, False, False]
    assert results[0].reason.startswith("height is read-only: ")
    assert results[2].reason == "publish_map_tf is a bool, not an integer"
    assert results[3].reason.startswith("there is no parameter nothing")
    assert mark().message.startswith('mark "dock" at x ')
    # All are changed, or none.
    off = [ros.Parameter("publish_map_tf", value(1, False)), ros.Parameter("height", value(3, 1.5))]
    assert not change_all(off).result.successful
    assert get(["publish_map_tf"]).values[0].bool_value
    assert change_all(off[:1]).result.successful
    before = len(transforms)
    play(recording, lambda number: images.write(recording.image(number)), numbers=range(60, 181))
    ended(program, recording, odometry)
    edges = {(t.header.frame_id, t.child_frame_id) for _, tf in transforms[before + 5 :] for t in tf.transforms}
    assert edges == {("odom", "camera_optical")}
    changed = [(e.node, p.name) for _, e in events for p in e.changed_parameters]
    assert changed == [("/odograph", "mark_name"), ("/odograph", "publish_map_tf")]


def test_damaged_calls_and_clients_that_vanish_stop_nothing(simulated, recording, robot, tmp_path):
    odometry = robot.listen("/odom", ros.Odometry)
    images = robot.writer("/camera/image_raw", ros.Image)
    program = Program(tmp_path, f"live ros2:/camera/image_raw {given(simulated)} --ros2 -o live")
    until(lambda: matched(images), what="the subscription")
    play(recording, lambda number: images.write(recording.image(number)), numbers=range(60))
    until(lambda: odometry, what="the odometry")
    code = (
        "import sys, robot\n"
        "client = robot.Robot(int(sys.argv[1])).client('/odograph/mark', 'Trigger')\n"
        "robot.until(client.is_there)\n"
        "[client.send() for _ in range(50)]\n"
        "client.writer.wait_for_acks(robot.duration(seconds=5))\n"
        "robot.os.kill(robot.os.getpid(), 9)\n"
    )
    domain = os.environ["ROS_DOMAIN_ID"]
    killed = subprocess.run([sys.executable, "-c", code, domain], cwd=os.path.dirname(__file__), check=False)
    assert killed.returncode == -9
    # Sixteen bytes of its header, and then nothing of what a request of parameters has.
    other = Robot(int(os.environ["ROS_DOMAIN_ID"]))
    damaged = other.client("/odograph/get_parameters", "CutOff")
    until(damaged.is_there, what="the service")
    damaged.send()
    mark = robot.client("/odograph/mark", "Trigger")
    get = robot.client("/odograph/get_parameters", "GetParameters")
    # Clients that call at once get their own replies.
    answers = {}
    clients = [robot.client("/odograph/mark", "Trigger") for _ in range(4)]
    callers = [
        threading.Thread(target=lambda client: answers.update({client: client()}), args=[client])
        for client in clients
    ]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len({reply.message.split('"')[1] for reply in answers.values()}) == 4, answers
    assert mark().success
    assert get(["height"]).values[0].type == 3
    play(recording, lambda number: images.write(recording.image(number)), numbers=range(60, 181))
    ended(program, recording, odometry)
    other.close()


def launched(arguments):
    """The command of the example for launch, which is not installed here, with these arguments."""
    kept = {}

    def keep(name):
        return lambda *args, **kwargs: kept.setdefault(name, []).append((args, kwargs))

    def configuration(name):
        declared = {args[0]: kwargs["default_value"] for args, kwargs in kept["argument"]}
        return types.SimpleNamespace(perform=lambda context: arguments.get(name, declared[name]))

    stubs = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {
            "DeclareLaunchArgument": keep("argument"),
            "ExecuteProcess": keep("process"),
            "OpaqueFunction": lambda function: function,
        },
        "launch.substitutions": {"LaunchConfiguration": configuration},
    }
    for name, members in stubs.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(members)
    path = Path(__file__).parents[1] / "examples/odograph.launch.py"
    example = runpy.run_path(str(path))
    example["generate_launch_description"]()[-1](None)
    (_, options) = kept["process"][0]
    assert options["respawn"] and options["cmd"][0] == "odograph"
    return " ".join(options["cmd"][1:])


def test_the_example_for_launch_runs(simulated, recording, robot, tmp_path):
    odometry = robot.listen("/vo/odom", ros.Odometry)
    images = robot.writer("/front/image_raw", ros.Image)
    arguments = {"image": "/front/image_raw", "odometry": "/vo/odom", "options": given(simulated)}
    program = Program(tmp_path, launched(arguments))
    start, stop = (robot.client(f"/odograph/{name}", "Trigger") for name in ["start", "stop"])
    until(lambda: matched(images), what="the subscription")
    assert start().success
    play(recording, lambda number: images.write(recording.image(number)), numbers=range(90))
    until(lambda: odometry, what="the odometry")
    assert stop().success
    code, said = program.end()
    assert code == 0, said
    # The folder is named by date and time.
    (folder,) = tmp_path.glob("live-*")
    assert len(poses(folder / "trajectory.csv")) > 60
