"""An escort that loses a member half way: the vehicle and the others go on, and nobody begins anew."""

from pathlib import Path

import consat as cs

escort = cs.load(Path(__file__).with_name("escort.yaml"))
session = cs.Session(escort).step(260)  # 13 s at 20 rounds a second
session.remove("left")
session.change("right", "displacement(vehicle)", vector=[-0.8, -0.8])  # guards the rear, too
session.step(280)

result = session.result()
print(result)
assert result.summary["motion"]["contacts"] == 0
result.plot("escort")
