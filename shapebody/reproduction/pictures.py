"""The README's picture of a start design, the one found from it, and the reference."""

import io
import json

from shapebody.arguments import require_output
from shapebody.files import atomic_write
from shapebody.reproduction.results import result_provenance
from shapebody.show import video


def before_after(agent, robot, path, start: int = 3, trust_region: float = 100.0) -> None:
    """Save a picture of a start design, the design VGDS finds from it, and the reference.

    The PNG's text entry "provenance" says of which agent.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    from shapebody.design.space import DesignSpace
    from shapebody.optimizers.search import search

    path = require_output("path", path)
    space = DesignSpace(robot)
    f = space.start(start)
    found = search("vgds", agent, robot, f, trust_region=trust_region).design
    models = [space.to_model(x) for x in (f, found, space.reference)]
    labels = [f"start design {start}", "found by VGDS", "reference"]
    picture = video.body_grid(models, labels=labels, columns=3)
    source = PngInfo()
    source.add_text(
        "provenance", json.dumps(result_provenance(agent, start=start, trust_region=trust_region))
    )
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", pnginfo=source)
    atomic_write(path, buffer.getvalue())
