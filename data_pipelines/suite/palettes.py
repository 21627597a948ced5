"""Named colour schemes, one for each robot of a family. Colours 0..255, as RGB."""

from __future__ import annotations

from data_pipelines.suite.spec import Palette

# fmt: off
SAND = Palette("sand", floor=(214, 200, 172), outside=(170, 150, 120), pattern="plain",
    robot=((46, 78, 150), (228, 112, 44), (40, 44, 60)), objects=((206, 52, 60), (40, 140, 96), (120, 70, 150)))
SLATE = Palette("slate", floor=(84, 98, 112), outside=(56, 64, 74), pattern="tiles",
    robot=((240, 210, 84), (244, 232, 170), (220, 84, 60)), objects=((86, 206, 220), (240, 130, 150), (240, 240, 240)))
MINT = Palette("mint", floor=(172, 212, 188), outside=(120, 160, 140), pattern="rings",
    robot=((112, 44, 116), (56, 56, 70), (244, 232, 206)), objects=((232, 96, 56), (40, 92, 190), (236, 196, 40)))
NIGHT = Palette("night", floor=(44, 48, 64), outside=(26, 28, 38), pattern="tiles",
    robot=((232, 92, 84), (250, 180, 90), (236, 232, 222)), objects=((90, 220, 130), (110, 150, 250), (250, 230, 90)))
CHALK = Palette("chalk", floor=(226, 226, 220), outside=(176, 176, 176), pattern="plain",
    robot=((38, 42, 50), (196, 48, 44), (240, 170, 50)), objects=((36, 110, 200), (30, 150, 90), (220, 110, 170)))
WOOD = Palette("wood", floor=(190, 144, 98), outside=(226, 220, 210), pattern="table",
    robot=((54, 62, 74), (40, 124, 184), (244, 244, 238)), objects=((120, 30, 60), (248, 220, 90), (40, 110, 70)))
SKY = Palette("sky", floor=(146, 186, 222), outside=(232, 234, 230), pattern="table",
    robot=((238, 110, 44), (64, 72, 98), (252, 238, 196)), objects=((150, 40, 120), (250, 230, 80), (30, 110, 80)))
ROAD = Palette("road", floor=(112, 150, 90), outside=(104, 104, 110), pattern="stripe",
    robot=((226, 56, 54), (252, 238, 150), (34, 34, 40)), objects=((250, 250, 244), (60, 90, 200), (250, 160, 40)))
PLUM = Palette("plum", floor=(96, 62, 104), outside=(62, 42, 70), pattern="rings",
    robot=((116, 216, 178), (244, 244, 214), (244, 150, 84)), objects=((250, 210, 70), (90, 170, 250), (244, 110, 130)))
CLAY = Palette("clay", floor=(178, 100, 76), outside=(124, 76, 62), pattern="stripe",
    robot=((242, 230, 206), (54, 84, 100), (252, 200, 70)), objects=((60, 200, 190), (70, 40, 90), (250, 250, 240)))
# fmt: on
