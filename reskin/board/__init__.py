"""Communication with boards, from the port to frames without faults.

- `port` opens a port and reads bytes; `find` detects which board is on which port.
- `wire` has the formats of the ReSkin and AnySkin firmware. `other_firmware` reads the lines or binary frames that a
  user describes. `stream` splits any bytes into frames, and accounts for every byte.
- `chips` has the steps and the limits of magnetometers: add your chip there.
- `faults` says which readings are faulty, such as when a chip is called stuck (`StuckChips`).
- `rates` measures the frame rate, and says what limits it. `reskin.recordings.fault_policy` says what is done with
  faulty readings.
"""
