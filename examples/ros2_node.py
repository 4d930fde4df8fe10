"""Publish the contacts of a skin in ROS 2: python ros2_node.py --ros-args -p port:=/dev/ttyACM0

Written for ROS 2 with Python 3.11 or newer, such as Jazzy on Ubuntu 24.04 (Python 3.12) and later. Humble has Python
3.10 and cannot import the library. This example was not run in a ROS 2 installation.

Install the library for the Python of ROS 2. Nothing may touch the skin in the first second. Place and moment are in the
frame of the labels, whose z axis points out of the skin. Readings that are not usable are logged and not published, so
a subscriber must check the age of the last message.
"""

import math

import rclpy
from geometry_msgs.msg import PointStamped, WrenchStamped
from rclpy.executors import ExternalShutdownException
from std_srvs.srv import Trigger

import reskin

FRAME_ID, QUEUE_N, M_PER_MM = "skin", 10, 1e-3


def publish(contact, place, wrench) -> None:
    """Publish the force, which is 0 without contact, and the place if the skin is touched."""
    touched = math.isfinite(contact.x_mm)
    x_m, y_m = (M_PER_MM * contact.x_mm, M_PER_MM * contact.y_mm) if touched else (0.0, 0.0)
    message = stamped(WrenchStamped(), contact)
    message.wrench.force.z = -contact.F_N  # a press acts along -z
    message.wrench.torque.x, message.wrench.torque.y = -y_m * contact.F_N, x_m * contact.F_N
    wrench.publish(message)
    if touched:
        message = stamped(PointStamped(), contact)
        message.point.x, message.point.y = x_m, y_m
        place.publish(message)


def stamped(message, contact):
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(contact.t_s * 1e9), 10**9)
    message.header.frame_id = FRAME_ID
    return message


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("reskin")
    place = node.create_publisher(PointStamped, "~/place", QUEUE_N)
    wrench = node.create_publisher(WrenchStamped, "~/wrench", QUEUE_N)
    try:
        with reskin.open(node.declare_parameter("port", "/dev/ttyACM0").value) as skin:

            def zero(_request, response):
                skin.zero()
                response.success, response.message = True, "the next second without contact becomes the no-load reading"
                return response

            node.create_service(Trigger, "~/zero", zero)
            for contact in skin:
                rclpy.spin_once(node, timeout_sec=0.0)  # answers calls of service ~/zero
                if contact.usable:
                    publish(contact, place, wrench)
                else:
                    node.get_logger().warning("; ".join(contact.alarms), throttle_duration_sec=1.0)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
