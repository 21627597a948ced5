"""Named colour schemes that the embodiment table picks from. Colours 0..255, as RGB."""

from __future__ import annotations

from data_pipelines.suite.spec import Look

# fmt: off
SAND = Look(floor=(196, 188, 172),
    robot=((52, 84, 150), (226, 122, 52), (70, 70, 80)))
SLATE = Look(floor=(84, 98, 108), outside=(60, 66, 72),
    robot=((238, 208, 88), (240, 226, 150), (220, 90, 70)))
MINT = Look(floor=(168, 198, 180),
    robot=((110, 52, 110), (60, 60, 72), (240, 232, 210)))
NIGHT = Look(floor=(50, 54, 66), outside=(34, 36, 44),
    robot=((206, 92, 84), (232, 166, 96), (232, 228, 220)))
CHALK = Look(floor=(222, 222, 218), outside=(190, 190, 190),
    robot=((44, 48, 54), (190, 56, 50), (236, 170, 60)))
WOOD = Look(floor=(186, 146, 106), outside=(214, 210, 204), pattern="table",
            robot=((62, 68, 76), (52, 116, 170), (240, 240, 236)))
SKY = Look(floor=(150, 180, 206), outside=(226, 228, 224), pattern="slope",
           robot=((236, 120, 60), (70, 76, 96), (250, 236, 200)))
ROAD = Look(floor=(118, 146, 96), outside=(108, 108, 112), pattern="stripe",
            robot=((222, 66, 62), (250, 236, 160), (36, 36, 40)))
PLUM = Look(floor=(92, 66, 96), outside=(64, 48, 70),
    robot=((122, 208, 176), (240, 240, 214), (240, 150, 90)))
LAB = Look(floor=(206, 212, 220), outside=(128, 138, 150),
    robot=((238, 240, 242), (40, 110, 190), (40, 44, 52)))
CLAY = Look(floor=(170, 104, 82), outside=(130, 84, 70),
    robot=((236, 226, 206), (66, 92, 104), (250, 200, 80)))
SEA = Look(floor=(58, 110, 128), outside=(44, 84, 100),
    robot=((246, 236, 220), (238, 112, 92), (250, 206, 100)))
# fmt: on
