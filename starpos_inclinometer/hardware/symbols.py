# SPDX-License-Identifier: Apache-2.0
"""Symbols of the schematics: boxes and two-terminal parts, with pins named and numbered as in the data sheets."""

from dataclasses import dataclass

# Grid of KiCad's schematics (mm).
GRID = 2.54
# Electrical kinds of pins, as KiCad's rule check names them.
KINDS = {
    "i": "input",
    "o": "output",
    "b": "bidirectional",
    "t": "tri_state",
    "p": "passive",
    "c": "open_collector",
    "P": "power_in",
    "W": "power_out",
}


@dataclass(frozen=True)
class Pin:
    """Pin of a symbol: its outer end at (x, y) mm from the symbol's middle, y down; `inward` is +1 or -1 along x."""

    number: str
    name: str
    kind: str
    x: float
    y: float
    inward: int
    length: float = GRID


@dataclass(frozen=True)
class Symbol:
    """Symbol of a part.

    prefix    of its references, such as R
    pins      in the order of a part's nets
    width_mm  and height_mm: the body
    shape     box, resistor, capacitor, diode or crystal
    """

    name: str
    prefix: str
    pins: tuple[Pin, ...]
    width_mm: float
    height_mm: float
    shape: str = "box"


def chip(name: str, prefix: str, left: str, right: str, width: int = 10) -> Symbol:
    """Make a box from lines `NUMBER NAME KIND`; `-` leaves a gap; width in grid steps, even."""
    rows = [[line.split() for line in side.split("\n") if line.strip()] for side in (left, right)]
    height = max(len(side) for side in rows) + 1
    pins = []
    for side, inward in zip(rows, (1, -1), strict=True):
        x = -inward * (width / 2 + 1) * GRID
        for i, row in enumerate(side):
            if row != ["-"]:
                number, label, kind = row
                pins.append(Pin(number, label, KINDS[kind], x, (i - (height - 2) / 2) * GRID, inward))
    return Symbol(name, prefix, tuple(pins), width * GRID, height * GRID)


def _two_terminals(name: str, prefix: str, shape: str, names: tuple[str, str] = ("1", "2")) -> Symbol:
    ends = (
        Pin("1", names[0], "passive", -2 * GRID, 0.0, 1),
        Pin("2", names[1], "passive", 2 * GRID, 0.0, -1),
    )
    return Symbol(name, prefix, ends, 2 * GRID, 0.8 * GRID, shape)


RESISTOR = _two_terminals("R", "R", "resistor")
CAPACITOR = _two_terminals("C", "C", "capacitor")
BEAD = _two_terminals("FB", "FB", "resistor")
CRYSTAL = _two_terminals("Y", "Y", "crystal")
# Pin 1 is the cathode, as KiCad numbers diodes; it is drawn on the left.
DIODE = _two_terminals("D", "D", "diode", ("K", "A"))
POWER_FLAG = Symbol("PWR_FLAG", "#FLG", (Pin("1", "pwr", "power_out", 0.0, 0.0, 1, 0.0),), GRID, GRID, "flag")

ARDUINO_NANO = chip(
    "Arduino_Nano",
    "A",
    """
    1 D1/TX b
    2 D0/RX b
    5 D2 b
    6 D3 b
    7 D4 b
    8 D5 b
    9 D6 b
    10 D7 b
    11 D8 b
    12 D9 b
    13 D10 b
    14 D11 b
    15 D12 b
    16 D13 b
    4 GND P
    """,
    """
    27 +5V W
    17 3V3 W
    30 VIN p
    3 ~RESET i
    28 ~RESET i
    18 AREF p
    19 A0 b
    20 A1 b
    21 A2 b
    22 A3 b
    23 A4 b
    24 A5 b
    25 A6 p
    26 A7 p
    29 GND P
    """,
)
ATMEGA8 = chip(
    "ATmega8",
    "U",
    """
    1 PC6/~RESET i
    9 PB6/XTAL1 p
    10 PB7/XTAL2 p
    14 PB0/ICP1 b
    15 PB1 b
    16 PB2/~SS b
    17 PB3/MOSI b
    18 PB4/MISO b
    19 PB5/SCK b
    7 VCC P
    20 AVCC P
    21 AREF p
    8 GND P
    22 GND P
    """,
    """
    2 PD0/RXD b
    3 PD1/TXD b
    4 PD2/INT0 b
    5 PD3/INT1 b
    6 PD4 b
    11 PD5 b
    12 PD6 b
    13 PD7 b
    23 PC0 b
    24 PC1 b
    25 PC2 b
    26 PC3 b
    27 PC4 b
    28 PC5 b
    """,
    12,
)
AD7730 = chip(
    "AD7730",
    "U",
    """
    9 AVDD P
    14 REF_IN(+) p
    15 REF_IN(-) p
    10 AIN1(+) i
    11 AIN1(-) i
    12 AIN2(+) i
    13 AIN2(-) i
    7 VBIAS o
    16 ACX o
    17 ~ACX o
    8 AGND P
    """,
    """
    23 DVDD P
    1 SCLK i
    22 DIN i
    21 DOUT t
    19 ~CS i
    20 ~RDY o
    4 POL i
    5 ~SYNC i
    6 ~RESET i
    18 ~STANDBY i
    2 MCLK_IN p
    3 MCLK_OUT p
    24 DGND P
    """,
)
SCA100T = chip(
    "SCA100T-D01",
    "U",
    """
    12 VDD P
    11 OUT_1 o
    5 OUT_2 o
    10 ST_1 i
    9 ST_2 i
    6 GND P
    """,
    """
    1 SCK i
    4 MOSI i
    3 MISO t
    7 CSB i
    2 NC p
    8 NC p
    """,
)
SCL3300 = chip(
    "SCL3300-D01",
    "U",
    """
    5 CSB i
    8 SCK i
    7 MOSI i
    6 MISO t
    2 A_EXTC p
    10 D_EXTC p
    """,
    """
    4 VDD P
    9 DVIO P
    1 AVSS P
    11 DVSS P
    12 EMC_GND P
    3 RESERVED p
    """,
)
BUFFER_125 = chip(
    "74x125",
    "U",
    """
    1 1~OE i
    2 1A i
    4 2~OE i
    5 2A i
    10 3~OE i
    9 3A i
    13 4~OE i
    12 4A i
    """,
    """
    -
    3 1Y t
    -
    6 2Y t
    14 VCC P
    8 3Y t
    7 GND P
    11 4Y t
    """,
    8,
)
OPTOCOUPLER = chip(
    "6N139",
    "U",
    """
    2 A p
    3 K p
    """,
    """
    8 VCC P
    6 VO c
    7 VB p
    5 GND P
    """,
    8,
)
CLAMP = chip("BAT54S", "D", "1 A p\n3 COM p\n2 K p", "", 4)
OPERATIONAL_AMPLIFIER = chip("MCP601", "U", "3 IN+ i\n2 IN- i", "7 VDD P\n6 OUT o\n4 VSS P", 6)


def connector(count: int) -> Symbol:
    """Make the symbol of a connector with pins 1 to `count`."""
    return chip(f"Connector_{count}", "J", "\n".join(f"{i} {i} p" for i in range(1, count + 1)), "", 4)
