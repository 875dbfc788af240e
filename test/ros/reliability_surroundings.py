#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""What is around the chain: a master that goes, listeners that go and come back, a camera whose
clock is wrong. Run with --feed RIG_BAG SECONDS it is the vehicle of the first case."""
import contextlib
import copy
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from reliability_feed import Drive, Feed, small_cameras  # noqa: E402
from sensor_msgs.msg import Image, PointCloud2  # noqa: E402

MASTER_GONE_S = 20.0
START_S = 120.0
PERIOD_S = 0.1


def forward(message, shift_s):
    """A copy whose stamps are later."""
    message = copy.deepcopy(message)
    for stamped in getattr(message, "transforms", [message]):
        stamped.header.stamp += rospy.Duration.from_sec(shift_s)
    return message


def feed(bag, seconds):
    """Publishes the scans of a bag at 10 Hz, one after another on and on, `left` always silent.

    Says `ready` when the first clouds come out, then `lost` messages and clouds after a line on
    stdin and the given time."""
    import rosbag

    rospy.init_node("vehicle", disable_signals=True)
    with rosbag.Bag(bag) as file:
        messages = [(topic, message) for topic, message, _ in file.read_messages()]
    messages = [row for row in messages if row[0] not in ("/left/image", "/left/scores")]
    types = {topic: type(message) for topic, message in messages}
    publishers = {
        topic: rospy.Publisher(topic, kind, queue_size=100, latch=topic == "/tf_static")
        for topic, kind in types.items()
    }
    clouds = []
    rospy.Subscriber("/points_semantic", PointCloud2, lambda m: clouds.append(m), queue_size=100)
    scans = sum(topic == "/points" for topic, _ in messages)
    sent, stop = [0], threading.Event()

    def publish():
        lap = 0
        while not stop.is_set():
            start = time.monotonic()
            for topic, message in messages:
                publishers[topic].publish(forward(message, lap * scans * PERIOD_S))
                if topic == "/points":
                    sent[0] += 1
                    while time.monotonic() < start + sent[0] % scans * PERIOD_S:
                        time.sleep(0.005)
            lap += 1
            time.sleep(max(0.0, start + scans * PERIOD_S - time.monotonic()))

    thread = threading.Thread(target=publish)
    thread.start()
    deadline = time.monotonic() + START_S
    while len(clouds) < 5:
        if time.monotonic() > deadline:
            os._exit(1)  # the publishing thread goes on
        time.sleep(0.05)
    print("ready", flush=True)
    sys.stdin.readline()
    before, published = len(clouds), sent[0]
    time.sleep(seconds)
    print("%d %d" % (sent[0] - published, len(clouds) - before), flush=True)
    stop.set()
    thread.join()


def free_port():
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def process(command, **options):
    child = subprocess.Popen(command, start_new_session=True, **options)
    try:
        yield child
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGINT)
            try:
                child.wait(20.0)
            except subprocess.TimeoutExpired:
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()


class Surroundings(Feed):
    drive = Drive(scans=12, cameras=small_cameras(), points_per_scan=800)
    timeouts = {"cameras.front": 3, "cameras.left": 3, "odometry": 3, "reference": 3}

    def test_1_the_only_listener_leaves_and_comes_back(self):
        """At most the scan is lost that comes while nobody listens."""
        messages = self.shifted()
        away_s = 0.5
        received = self.semantic.messages
        publish = threading.Thread(target=self.publish, args=(messages,), kwargs={"pace": 4.0})
        publish.start()
        self.semantic.wait_for(len(received) + 3)
        self.semantic.close()
        time.sleep(away_s)
        type(self).semantic = live.Received("/points_semantic", PointCloud2)
        publish.join()
        # All that went in came out of the chain, whoever listened.
        live.wait_until(
            lambda: self.count("projection", "output /points_semantic messages")
            == self.count("motion_compensation", "input /points messages")
            >= self.drive.scans,
            lambda: "every scan\n" + self.diagnostics.text(),
        )
        gone = int(away_s / (4.0 * PERIOD_S)) + 2
        self.assertGreaterEqual(len(received) + 3 + len(self.semantic) + gone, self.drive.scans)

    def test_2_one_camera_of_another_time_stops_nothing(self):
        """Row 36: ahead, behind, and now and then; it is named and counted, all else goes on."""
        for number, (shift_s, every) in enumerate(((10, 1), (-10, 1), (3600, 2))):
            calls = [0]

            def change(topic, message, shift_s=shift_s, every=every, calls=calls):
                if topic not in ("/front/scores", "/front/image"):
                    return message
                calls[0] += 1
                return forward(message, shift_s) if calls[0] % (2 * every) < 2 else message

            clouds = self.run_drive(change, scans=self.drive.scans - 2, pace=2.0)
            stamps = [cloud.header.stamp for cloud in clouds]
            self.assertEqual(stamps, sorted(stamps))
        live.wait_until(
            lambda: self.count(
                "image_selection", "dropped: /front/image, stamp disagrees with points"
            ),
            lambda: "a count of the camera\n" + self.diagnostics.text(),
        )
        self.said.wait_for(
            r"/front/image: stamp .* s is .* s (behind|ahead of) the newest of points"
        )

    def test_3_a_decision_older_than_all_that_are_known(self):
        """The manager lives (see tearDown) and fuses on."""
        from sensor_msgs.msg import TimeReference

        publisher = rospy.Publisher("/scan_reference", TimeReference, queue_size=100)
        live.wait_until(publisher.get_num_connections, "the chain")
        for k in list(range(40)) + [-90]:
            message = TimeReference()
            message.header.stamp = message.time_ref = rospy.Time(1546300900, 0) + rospy.Duration(
                0.01 * k
            )
            publisher.publish(message)
            rospy.rostime.wallsleep(0.01)
        self.assertEqual(len(self.run_drive(pace=2.0)), self.drive.scans)
        publisher.unregister()

    def test_4_scans_go_on_without_the_master(self):
        """A silent camera makes the watchdog ask the master; none of the manager's threads waits
        for the answer."""
        port = free_port()
        environment = dict(os.environ, ROS_MASTER_URI="http://127.0.0.1:%d" % port)
        with live.folder() as path:
            made = live.Made(path, self.drive)
            chain = live.launch_command("fusion.launch", rig=made.rig, bond="false", threads=2)
            vehicle = [sys.executable, os.path.abspath(__file__), "--feed", made.bag]
            pipes = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, universal_newlines=True)
            with process(["rosmaster", "--core", "-p", str(port)], env=environment) as master:
                with process(chain, env=environment):
                    with process(
                        vehicle + [str(MASTER_GONE_S)], env=environment, **pipes
                    ) as vehicle:
                        self.assertEqual(vehicle.stdout.readline().strip(), "ready")
                        os.killpg(master.pid, signal.SIGKILL)
                        master.wait()
                        vehicle.stdin.write("\n")
                        vehicle.stdin.flush()
                        sent, came = map(int, vehicle.stdout.readline().split())
        self.assertGreater(sent, 0.5 * MASTER_GONE_S / PERIOD_S)
        self.assertGreaterEqual(came, 0.95 * sent)


if __name__ == "__main__":
    if "--feed" in sys.argv:
        feed(sys.argv[2], float(sys.argv[3]))
    else:
        rospy.init_node("reliability_surroundings")
        rostest.rosrun("semantic_lidar_fusion", "reliability_surroundings", Surroundings)
