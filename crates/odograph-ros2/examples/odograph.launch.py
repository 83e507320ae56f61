"""odograph beside the driver of a camera.

    ros2 launch odograph.launch.py image:=/camera/image_raw odometry:=/odom
    ros2 launch odograph.launch.py options:="--camera camera.yaml --height 90cm --ros2-without map-tf"
    ros2 service call /odograph/start std_srvs/srv/Trigger
    ros2 service call /odograph/stop std_srvs/srv/Trigger

Each run waits for the first service and ends with the second; then the next one waits. Its results
are in a folder named by date and time, below the one in which `ros2 launch` was called.
"""

import shlex

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration


def program(context):
    image, odometry, options = (
        LaunchConfiguration(name).perform(context) for name in ["image", "odometry", "options"]
    )
    command = ["odograph", "live", f"ros2:{image}", f"--ros2={odometry}", "--ros2-wait"]
    return [
        ExecuteProcess(
            cmd=[*command, *shlex.split(options)],
            name="odograph",
            output="screen",
            respawn=True,
            respawn_delay=1.0,
            # After an interrupt it writes its results.
            sigterm_timeout="60",
            sigkill_timeout="10",
        )
    ]


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "image", default_value="/camera/image_raw", description="topic of the images"
            ),
            DeclareLaunchArgument(
                "odometry", default_value="/odom", description="topic of the odometry"
            ),
            DeclareLaunchArgument(
                "options", default_value="", description="further options of odograph live"
            ),
            OpaqueFunction(function=program),
        ]
    )
