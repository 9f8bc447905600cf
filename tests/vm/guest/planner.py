"""The shortest planner in Python: one line a pose, run and sequence."""

import cairn

for pose in cairn.poses():
    print(pose.run_id, pose.sequence, "drive" if pose.usable(0.2) else "stop", flush=True)
