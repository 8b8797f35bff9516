"""A better Go2 in a few minutes, without a notebook: `make demo`.

From start design 3 of the paper, VGDS searches for a better body. The frozen policy then walks with
four bodies: the start, what the penalty alone finds ("penalty only"), what VGDS finds, and the
reference. Writes better_go2.xml, better_go2.png and better_go2.mp4 into the current folder.
"""

import time

import numpy as np
from PIL import Image

import shapebody as sb
from shapebody.files import atomic_write
from shapebody.runtime import enable_compilation_cache
from shapebody.show import video

START, TRUST_REGION, EPISODES, SECONDS = 3, 100.0, 50, 5.0


def say(text: str) -> None:
    """A line with the seconds since the beginning."""
    print(f"{time.monotonic() - BEGAN:4.0f} s  {text}", flush=True)


def main() -> None:
    enable_compilation_cache()
    say("loading the Unitree Go2 and its agent")
    robot, agent = sb.load_robot("unitree_go2"), sb.load_agent("unitree_go2")
    space = sb.DesignSpace(robot)
    start = space.start(START)

    say(f"searching from start design {START} with λ = {TRUST_REGION:g} (compiling, about 10 s)")
    found = {
        method: sb.search(method, agent, robot, start, trust_region=TRUST_REGION).design
        for method in ("penalty-only", "vgds")
    }
    bodies = {
        f"start design {START}": start,
        "penalty only": found["penalty-only"],
        "VGDS": found["vgds"],
        "reference": space.reference,
    }
    designs = np.stack(list(bodies.values()))

    say(f"walking: {EPISODES} episodes of 20 s with each of four bodies (compiling, about 40 s)")
    score = sb.evaluate(agent, robot, designs, episodes=EPISODES)
    low, high = score.interval()
    print(f"\n{'body':16s} {'return [95 % interval]':26s} {'tracking error':>14s} {'survived':>9s}")
    for i, name in enumerate(bodies):
        text = f"{score.mean[i]:6.2f} [{low[i]:.2f}, {high[i]:.2f}]"
        survived = score.lengths[i].mean() * 0.02
        print(f"{name:16s} {text:26s} {score.mean_tracking_error[i]:10.3f} m/s {survived:7.1f} s")
    gain = sb.paired_gain(score.returns[2], score.returns[1])
    print(
        f"VGDS over penalty only, paired by episode: {gain.mean:+.2f} "
        f"[{gain.low:+.2f}, {gain.high:+.2f}]. One start; notebook 06 has ten.\n"
    )

    say("drawing")
    models = [space.to_model(f) for f in designs]
    picture = video.body_grid(models, labels=list(bodies), columns=4)
    Image.fromarray(picture).save("better_go2.png")
    clips = []
    for f, model in zip(designs[[0, 2]], (models[0], models[2]), strict=True):
        recording = sb.record_episode(agent, robot, f, seconds=SECONDS, command=(0.6, 0.0, 0.0))
        clips.append(video.render_rollout(model, recording.qpos, distance=1.8, width=320))
    frames = video.side_by_side(*clips, labels=[f"start design {START}", "VGDS"])
    written = video.save_video("better_go2.mp4", frames)
    atomic_write("better_go2.xml", space.to_mjcf(bodies["VGDS"]))
    say(f"wrote better_go2.xml, better_go2.png and {written}")


BEGAN = time.monotonic()

if __name__ == "__main__":
    main()
