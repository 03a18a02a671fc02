"""ROS 2: a node between the microphone's topic and the recogniser's. NOT TRIED.

    python ros2_node.py            # in a sourced ROS 2 environment

This file has never run in ROS 2: there was none on the machine it was written on. What a test runs is the part without
ROS, `filtered`, on the bundled recording. What was not tried: the message type below (audio_common_msgs/AudioData with
raw 16-bit mono at 16 kHz; other stacks have their own), quality of service, the executor's threads, and the delay that
topics add, which may change from message to message: where microphone and loudspeaker are on this computer, the filter
is better off with the devices themselves (`edgefilter run`).
"""

import numpy as np

from edgefilter.integrations.duplex import Duplex, as_pcm16, from_pcm16

RATE = 16_000


def filtered(duplex, data):
    """The bytes of a microphone's message, filtered: as many or fewer, and more the next time."""
    return as_pcm16(duplex.hear(from_pcm16(bytes(data)), RATE))


def main():
    import rclpy
    from audio_common_msgs.msg import AudioData
    from rclpy.node import Node
    from std_msgs.msg import Empty, String

    class Ears(Node):
        """/audio and /speech in; /human and /speech_events out; /speech_stopped where the robot was cut off."""

        def __init__(self):
            super().__init__("edgefilter")
            self.human = self.create_publisher(AudioData, "human", 10)
            self.events = self.create_publisher(String, "speech_events", 10)
            self.duplex = Duplex(on_event=lambda event: self.events.publish(String(data=event.kind)))
            self.create_subscription(AudioData, "speech", self.on_speech, 50)
            self.create_subscription(Empty, "speech_stopped", lambda _: self.duplex.interrupt(), 10)
            self.create_subscription(AudioData, "audio", self.on_audio, 50)

        def on_speech(self, message):
            self.duplex.play(from_pcm16(bytes(message.data)), RATE)

        def on_audio(self, message):
            self.human.publish(AudioData(data=np.frombuffer(filtered(self.duplex, message.data), np.uint8).tolist()))

    rclpy.init()
    rclpy.spin(Ears())


if __name__ == "__main__":
    main()
