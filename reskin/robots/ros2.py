"""A ROS 2 node that publishes the contacts of a skin as standard messages.

    python -m reskin.robots.ros2 --ros-args -p port:=/dev/ttyACM0

Run it with the Python of the ROS 2 installation, after `pip install .` of this project into the same environment.
Nothing may touch the skin in the first second.

| topic            | message                                   | content                                              |
|------------------|-------------------------------------------|------------------------------------------------------|
| `~/chip0/field`  | sensor_msgs/MagneticField                 | field in T along the chip's axes; also chip1, ...     |
| `~/contact`      | std_msgs/Bool                             | whether the skin is touched                          |
| `~/place`        | geometry_msgs/PoseWithCovarianceStamped   | place in m; published only in contact                |
| `~/force`        | geometry_msgs/WrenchStamped               | force on the skin in N; zero without contact         |
| `~/force_sd`     | geometry_msgs/WrenchStamped               | standard deviation of the force; only in contact     |
| `/diagnostics`   | diagnostic_msgs/DiagnosticArray           | alarms, once a second and whenever they change       |

Service `~/zero` (std_srvs/Trigger) takes a new no-load reading.

Parameters of the node:

* `port`: the port of the board. By default, this is the only connected board.
* `model` and `calibration`: files, as for `reskin live --model`. By default, the universal model is used without
  calibration.
* `external_uT`: for a board that a robot moves, the standard deviation in uT of the change of the external field along
  each axis, about 30 for the earth's field; see `reskin.load_universal`. The default 0 means that there is no such
  change.
* `baud`: the baud rate of the port.
* `frame_id`: the name of the skin's coordinate frame.
* `rate_hz`: the largest number of messages per second on each topic.

Design decisions:

* The field of each chip is published as a MagneticField message, because this message has a stamp (the time of the
  reading), a frame and SI units. A Float32MultiArray has none of these. The covariance in the message is 0, which means
  that it is unknown. The frame of chip K is `<frame_id>_chipK`.
* The frame `frame_id` has the axes and the origin of the places x and y; its z axis points out of the skin. Only x and
  y are estimated. The z of a place is always 0, which is the surface of the skin. The orientation of a place is always
  that of the frame. The covariances of z and of the orientation are 0.
* The model estimates normal forces, so the published force presses on the skin along -z. The force acts at the place of
  the contact, and the torque is the moment of the force about the origin. There is no standard message with a wrench
  and its covariance, so the standard deviation of the force is published as a separate message with the same stamp. In
  this message, components that are not estimated are NaN.
* A reading that is not usable is not published. Subscribers notice this because the last message becomes old; the
  reason is in `/diagnostics`. Stamps are times of arrival on the system's clock.
"""

import math
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import reskin
from reskin.board.find import find_board
from reskin.errors import ReskinError
from reskin.live.tracker import Contact, LiveSkin

if TYPE_CHECKING:
    from reskin.universal.model import Universal

T_PER_UT, M_PER_MM = 1e-6, 1e-3
DIAGNOSTICS_S = 1.0  # longest time between two messages with diagnostics
QUEUE_N = 10  # number of messages that a publisher keeps for slow subscribers
PARAMETERS = {  # names of the node's parameters -> their default values
    "port": "", "model": "", "calibration": "", "external_uT": 0.0, "baud": 115200, "frame_id": "skin",
    "rate_hz": 100.0,
}  # fmt: skip


class SkinPublisher:
    """An object that publishes contacts through a node of rclpy.

    The packages of the messages are imported only when the object is created, because they exist only in an
    installation of ROS 2.
    """

    def __init__(self, node: Any, skin: LiveSkin, frame_id: str) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
        from sensor_msgs.msg import MagneticField
        from std_msgs.msg import Bool
        from std_srvs.srv import Trigger

        self._skin, self._frame_id = skin, frame_id
        self._fields = [
            node.create_publisher(MagneticField, f"~/chip{chip}/field", QUEUE_N)
            for chip in range(skin.detected.chips_n)
        ]
        self._contact = node.create_publisher(Bool, "~/contact", QUEUE_N)
        self._place = node.create_publisher(PoseWithCovarianceStamped, "~/place", QUEUE_N)
        self._force = node.create_publisher(WrenchStamped, "~/force", QUEUE_N)
        self._force_sd = node.create_publisher(WrenchStamped, "~/force_sd", QUEUE_N)
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", QUEUE_N)
        node.create_service(Trigger, "~/zero", self._zero)
        self._alarms: tuple[str, ...] = ()
        self._diagnosed_s = -math.inf

    def publish(self, contact: Contact) -> None:
        """Publish the diagnostics of a reading and, if the reading is usable, all other messages."""
        self._publish_diagnostics(contact)
        if contact.usable:
            self._publish_fields(contact)
            if self._skin.estimator is not None:
                self._publish_estimate(contact)

    def _publish_fields(self, contact: Contact) -> None:
        from sensor_msgs.msg import MagneticField

        for chip, publisher in enumerate(self._fields):
            message = self._stamped(MagneticField(), contact, f"{self._frame_id}_chip{chip}")
            b_T = (T_PER_UT * contact.b_uT[3 * chip : 3 * chip + 3].astype(float)).tolist()
            message.magnetic_field.x, message.magnetic_field.y, message.magnetic_field.z = b_T
            publisher.publish(message)

    def _publish_estimate(self, contact: Contact) -> None:
        from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
        from std_msgs.msg import Bool

        touched = math.isfinite(contact.x_mm)
        self._contact.publish(Bool(data=touched))
        force = self._stamped(WrenchStamped(), contact)
        if touched:
            place, sd = self._stamped(PoseWithCovarianceStamped(), contact), self._stamped(WrenchStamped(), contact)
            x_m, y_m = M_PER_MM * contact.x_mm, M_PER_MM * contact.y_mm
            position, covariance = place.pose.pose.position, [0.0] * 36
            position.x, position.y = x_m, y_m
            place.pose.pose.orientation.w = 1.0
            covariance[0], covariance[7] = ((M_PER_MM * sd_mm) ** 2 for sd_mm in contact.sd_mm)
            place.pose.covariance = covariance
            force.wrench.force.z = -contact.F_N
            force.wrench.torque.x, force.wrench.torque.y = -y_m * contact.F_N, x_m * contact.F_N
            for vector in (sd.wrench.force, sd.wrench.torque):
                vector.x = vector.y = vector.z = math.nan
            sd.wrench.force.z = contact.sd_F_N
            self._place.publish(place)
            self._force_sd.publish(sd)
        self._force.publish(force)

    def _publish_diagnostics(self, contact: Contact) -> None:
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        now_s = time.monotonic()
        if contact.alarms == self._alarms and now_s - self._diagnosed_s < DIAGNOSTICS_S:
            return
        self._alarms, self._diagnosed_s = contact.alarms, now_s
        level = DiagnosticStatus.WARN if contact.usable else DiagnosticStatus.ERROR
        status = DiagnosticStatus(
            level=level if contact.alarms else DiagnosticStatus.OK,
            name=f"reskin: {self._frame_id}",
            message="; ".join(contact.alarms) or "no alarm",
            hardware_id=self._skin.port,
            values=[KeyValue(key="lost_bytes_n", value=str(self._skin.lost_bytes_n))],
        )
        self._diagnostics.publish(self._stamped(DiagnosticArray(status=[status]), contact, ""))

    def _stamped(self, message: Any, contact: Contact, frame_id: str | None = None) -> Any:
        """Set the stamp and the frame of a message, and return it."""
        nanoseconds = round(contact.t_s * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        message.header.frame_id = self._frame_id if frame_id is None else frame_id
        return message

    def _zero(self, _request: Any, response: Any) -> Any:
        self._skin.zero()
        response.success, response.message = True, "The next second without contact becomes the no-load reading."
        return response


def limit_rate(contacts: Iterator[Contact], rate_hz: float) -> Iterator[Contact | None]:
    """Yield at most `rate_hz` contacts per second; in place of each contact that is omitted, yield None."""
    next_s, period_s = -math.inf, 1 / rate_hz
    for contact in contacts:
        now_s = time.monotonic()
        if now_s >= next_s:
            # The next time is counted from the planned time, so that the mean rate is right even if contacts are
            # irregular.
            next_s = max(next_s, now_s - period_s) + period_s
            yield contact
        else:
            yield None


def find_model(model: str, calibration: str, external_uT: float) -> "Universal | Sequence[str]":
    """Return the argument `model` for `reskin.open`, from the node's parameters."""
    if external_uT:
        return reskin.load_universal(calibration or None, file=model or None, external_uT=external_uT)
    return [file for file in (model, calibration) if file]


def main(args: Sequence[str] | None = None) -> None:
    """Run the node until it is shut down."""
    import rclpy
    from rclpy.executors import ExternalShutdownException

    rclpy.init(args=args)
    node = rclpy.create_node("reskin")
    try:
        given = {name: node.declare_parameter(name, default).value for name, default in PARAMETERS.items()}
        model = find_model(given["model"], given["calibration"], given["external_uT"])
        port = given["port"] or find_board().port
        with reskin.open(port, model=model, baud=given["baud"]) as skin:
            publisher = SkinPublisher(node, skin, given["frame_id"])
            node.get_logger().info(f"publishing {skin.description}")
            for contact in limit_rate(iter(skin), given["rate_hz"]):
                rclpy.spin_once(node, timeout_sec=0.0)  # answers calls of service ~/zero
                if contact is not None:
                    publisher.publish(contact)
    except ReskinError as error:
        node.get_logger().fatal(str(error))
        raise SystemExit(error.exit_code) from None
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
