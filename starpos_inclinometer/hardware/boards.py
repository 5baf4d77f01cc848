# SPDX-License-Identifier: Apache-2.0
"""The two boards: every part, its manufacturer's number and its nets. All drawings and lists are made of this.

Pins that a part does not name are left open. Groups stand in columns on the sheet, each under a sentence on its job.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from symbols import (
    AD7730,
    ARDUINO_NANO,
    ATMEGA8,
    BEAD,
    BUFFER_125,
    CAPACITOR,
    CLAMP,
    CRYSTAL,
    DIODE,
    OPERATIONAL_AMPLIFIER,
    OPTOCOUPLER,
    RESISTOR,
    SCA100T,
    SCL3300,
    Symbol,
    connector,
)


@dataclass(frozen=True)
class Part:
    """One part; `nets` maps pin numbers to names of nets."""

    reference: str
    symbol: Symbol
    value: str
    manufacturer: str
    number: str
    nets: Mapping[str, str]


@dataclass(frozen=True)
class Group:
    """Parts that do one job."""

    says: str
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Board:
    """A board; `powered` are nets whose supply comes in by passive pins."""

    name: str
    title: str
    columns: tuple[tuple[Group, ...], ...]
    powered: tuple[str, ...]

    def parts(self) -> list[Part]:
        return [part for column in self.columns for group in column for part in group.parts]


RESISTORS = {
    "976": "976R",
    "1k": "1K",
    "2.2k": "2K2",
    "4.7k": "4K7",
    "10k": "10K",
    "100k": "100K",
}
CAPACITORS = {
    "100n": ("KEMET", "C320C104K5R5TA"),
    "10n C0G": ("TDK", "FG18C0G1H103JNT06"),
    "22p": ("Vishay", "K220J15C0GF5TL2"),
    "10u": ("Panasonic", "ECA-1HM100"),
}


def _nets(text: str) -> dict[str, str]:
    """Read nets as `PIN NET, PIN NET`."""
    return dict(pair.split() for pair in text.split(", "))


def _r(reference: str, value: str, one: str, two: str) -> Part:
    number = f"MFR-25FBF52-{RESISTORS[value]}"
    return Part(reference, RESISTOR, value, "Yageo", number, {"1": one, "2": two})


def _r_precise(reference: str, value: str, code: str, one: str, two: str) -> Part:
    number = f"RG2012N-{code}-B-T5"
    return Part(reference, RESISTOR, f"{value} 0.1%", "Susumu", number, {"1": one, "2": two})


def _c(reference: str, value: str, one: str, two: str) -> Part:
    return Part(reference, CAPACITOR, value, *CAPACITORS[value], {"1": one, "2": two})


def _d(reference: str, value: str, number: str, cathode: str, anode: str) -> Part:
    return Part(reference, DIODE, value, "Vishay", number, {"1": cathode, "2": anode})


def _j(reference: str, value: str, manufacturer: str, number: str, *nets: str) -> Part:
    named = {str(i): net for i, net in enumerate(nets, 1) if net}
    return Part(reference, connector(len(nets)), value, manufacturer, number, named)


def _shutter() -> Group:
    """Make the shutter's input.

    The 1N4007 blocks a flash's voltage; the 1N4148 keeps its leakage from reversing the LED. The contact carries about
    1 mA. That lights a 6N139, and seldom keeps a camera's thyristor conducting after the exposure. A strobe line
    of 3.3 or 5 V works, too: low lights the LED.
    """
    parts = (
        _j("J2", "shutter: 1 contact 2 ground", "JST", "B2B-XH-A(LF)(SN)", "SHOE", "GND"),
        Part(
            "U3",
            OPTOCOUPLER,
            "6N139",
            "Vishay",
            "6N139",
            _nets("2 LED_A, 3 LED_K, 8 +5V, 6 SHUTTER, 5 GND"),
        ),
        _r("R1", "2.2k", "+5V", "LED_A"),
        _d("D1", "1N4007", "1N4007-E3/54", "SHOE", "LED_K"),
        _d("D2", "1N4148", "1N4148-TAP", "LED_A", "LED_K"),
        _r("R2", "4.7k", "+5V", "SHUTTER"),
        _c("C1", "100n", "+5V", "GND"),
    )
    return Group("Shutter: a closed contact or a low line lights the LED", parts)


def _second(buffer: Part) -> Group:
    """Make the receiver's input: TTL levels, so 3.3 V are high; open it is low."""
    parts = (
        _j("J3", "PPS: 1 pulse 2 ground", "JST", "B2B-XH-A(LF)(SN)", "PPS_IN", "GND"),
        Part("D3", CLAMP, "BAT54S", "Nexperia", "BAT54S,215", _nets("1 GND, 3 PPS_TTL, 2 +5V")),
        _r("R3", "1k", "PPS_IN", "PPS_TTL"),
        _r("R4", "100k", "PPS_TTL", "GND"),
        buffer,
        _c("C2", "100n", "+5V", "GND"),
    )
    return Group("Receiver's second; TTL inputs: 3.3 or 5 V", parts)


def _ahct(gates: str) -> Part:
    # Gates 3 and 4 are not used: inputs at ground, outputs off.
    nets = _nets(f"14 +5V, 7 GND, 9 GND, 10 +5V, 12 GND, 13 +5V, {gates}")
    return Part("U4", BUFFER_125, "74AHCT125", "Texas Instruments", "SN74AHCT125N", nets)


NANO = Board(
    "nano",
    "starpos inclinometer, Arduino Nano and SCL3300-D01",
    (
        (
            Group(
                "Microcontroller, powered by USB",
                (
                    Part(
                        "A1",
                        ARDUINO_NANO,
                        "Arduino Nano",
                        "Arduino",
                        "A000005",
                        _nets(
                            "4 GND, 29 GND, 27 +5V, 17 +3V3, 11 SHUTTER, 6 PPS, 13 CS, 14 MOSI, 15 MISO, "
                            "16 SCK"
                        ),
                    ),
                    _c("C3", "10u", "+5V", "GND"),
                    _r("R5", "10k", "+5V", "CS"),
                ),
            ),
            Group(
                "Level: 3.0 to 3.6 V",
                (
                    Part(
                        "U1",
                        SCL3300,
                        "SCL3300-D01",
                        "Murata",
                        "SCL3300-D01-1",
                        _nets(
                            "5 CS_3V3, 8 SCK_3V3, 7 MOSI_3V3, 6 MISO_3V3, 2 A_EXTC, 10 D_EXTC, 4 +3V3, "
                            "9 +3V3, 1 GND, 11 GND, 12 GND, 3 GND"
                        ),
                    ),
                    _c("C4", "100n", "+3V3", "GND"),
                    _c("C5", "100n", "+3V3", "GND"),
                    _c("C6", "100n", "A_EXTC", "GND"),
                    _c("C7", "100n", "D_EXTC", "GND"),
                    _r("R6", "100k", "MISO_3V3", "GND"),
                ),
            ),
        ),
        (
            Group(
                "5 V to 3.3 V: the inputs of 74LVC125 stand 5 V",
                (
                    Part(
                        "U2",
                        BUFFER_125,
                        "74LVC125",
                        "Texas Instruments",
                        "SN74LVC125AD",
                        _nets(
                            "14 +3V3, 7 GND, 1 GND, 2 CS, 3 CS_3V3, 4 GND, 5 SCK, 6 SCK_3V3, 10 GND, 9 MOSI, "
                            "8 MOSI_3V3, 13 +3V3, 12 GND"
                        ),
                    ),
                    _c("C8", "100n", "+3V3", "GND"),
                ),
            ),
            _second(
                # 2: MISO, off while the sensor is not selected, so that a programmer finds the line free.
                _ahct("1 GND, 2 PPS_TTL, 3 PPS, 4 CS, 5 MISO_3V3, 6 MISO")
            ),
        ),
        (_shutter(),),
    ),
    ("GND",),
)
PAPER = Board(
    "paper",
    "starpos inclinometer of the paper, ATmega8, AD7730 and SCA100T-D01",
    (
        (
            Group(
                "Microcontroller, 8 MHz",
                (
                    Part(
                        "U1",
                        ATMEGA8,
                        "ATmega8",
                        "Microchip",
                        "ATMEGA8-16PU",
                        _nets(
                            "1 RESET, 9 XTAL1, 10 XTAL2, 14 SHUTTER, 15 CS_SCA100T, 16 CS_AD7730, 17 MOSI, "
                            "18 MISO, 19 SCK, 7 +5V, 20 +5V, 21 AREF, 8 GND, 22 GND, 2 RXD, 3 TXD, 4 RDY, "
                            "5 PPS"
                        ),
                    ),
                    Part("Y1", CRYSTAL, "8 MHz", "Abracon", "ABLS-8.000MHZ-B4-T", _nets("1 XTAL1, 2 XTAL2")),
                    _r("R5", "10k", "+5V", "RESET"),
                    _c("C3", "22p", "XTAL1", "GND"),
                    _c("C4", "22p", "XTAL2", "GND"),
                    _c("C5", "100n", "+5V", "GND"),
                    _c("C6", "100n", "+5V", "GND"),
                    _c("C7", "100n", "AREF", "GND"),
                    _c("C8", "10u", "+5V", "GND"),
                    _r("R6", "10k", "+5V", "CS_AD7730"),
                    _r("R7", "10k", "+5V", "CS_SCA100T"),
                ),
            ),
            Group(
                "Serial line and supply (TTL-232R-5V), programmer",
                (
                    _j("J1", "USB adapter", "FTDI", "TTL-232R-5V", "GND", "", "+5V", "RXD", "TXD", ""),
                    _j(
                        "J4",
                        "ISP",
                        "Wuerth Elektronik",
                        "61300621121",
                        "MISO",
                        "+5V",
                        "SCK",
                        "MOSI",
                        "RESET",
                        "GND",
                    ),
                ),
            ),
        ),
        (
            Group(
                "Converter; +5VA is supply and reference",
                (
                    Part(
                        "U2",
                        AD7730,
                        "AD7730",
                        "Analog Devices",
                        "AD7730BNZ",
                        _nets(
                            "9 +5VA, 14 +5VA, 15 GND, 10 AIN1P, 11 AIN1N, 12 AIN2P, 13 AIN2N, 8 GND, 23 +5V, "
                            "1 SCK, 22 MOSI, 21 MISO, 19 CS_AD7730, 20 RDY, 4 +5V, 5 +5V, 6 +5V, 18 +5V, "
                            "2 MCLK1, 3 MCLK2, 24 GND"
                        ),
                    ),
                    Part(
                        "Y2",
                        CRYSTAL,
                        "4.9152 MHz",
                        "Abracon",
                        "ABLS-4.9152MHZ-B4-T",
                        _nets("1 MCLK1, 2 MCLK2"),
                    ),
                    Part(
                        "FB1",
                        BEAD,
                        "220R at 100 MHz",
                        "Murata",
                        "BLM21PG221SN1D",
                        _nets("1 +5V, 2 +5VA"),
                    ),
                    _c("C9", "22p", "MCLK1", "GND"),
                    _c("C10", "22p", "MCLK2", "GND"),
                    _c("C11", "100n", "+5VA", "GND"),
                    _c("C12", "10u", "+5VA", "GND"),
                    _c("C13", "100n", "+5V", "GND"),
                ),
            ),
            Group(
                "Level",
                (
                    Part(
                        "U5",
                        SCA100T,
                        "SCA100T-D01",
                        "Murata",
                        "SCA100T-D01-1",
                        _nets(
                            "12 +5VA, 11 OUT_1, 5 OUT_2, 10 GND, 9 GND, 6 GND, 1 SCK, 4 MOSI, 3 MISO, "
                            "7 CS_SCA100T"
                        ),
                    ),
                    _c("C14", "100n", "+5VA", "GND"),
                ),
            ),
        ),
        (
            Group(
                "Dividers by 31, about half the supply",
                (
                    _r_precise("R8", "30k", "303", "OUT_1", "AIN1P"),
                    _r_precise("R9", "1k", "102", "AIN1P", "MID"),
                    _r("R10", "976", "MID", "AIN1N"),
                    _c("C15", "10n C0G", "AIN1P", "AIN1N"),
                    _r_precise("R11", "30k", "303", "OUT_2", "AIN2P"),
                    _r_precise("R12", "1k", "102", "AIN2P", "MID"),
                    _r("R13", "976", "MID", "AIN2N"),
                    _c("C16", "10n C0G", "AIN2P", "AIN2N"),
                ),
            ),
            Group(
                "Half the supply",
                (
                    Part(
                        "U6",
                        OPERATIONAL_AMPLIFIER,
                        "MCP601",
                        "Microchip",
                        "MCP601-I/P",
                        _nets("3 HALF, 2 MID, 6 MID, 7 +5VA, 4 GND"),
                    ),
                    _r("R14", "10k", "+5VA", "HALF"),
                    _r("R15", "10k", "HALF", "GND"),
                    _c("C17", "100n", "HALF", "GND"),
                    _c("C18", "100n", "+5VA", "GND"),
                ),
            ),
            _shutter(),
        ),
        (_second(_ahct("1 GND, 2 PPS_TTL, 3 PPS, 5 GND, 4 +5V")),),
    ),
    ("GND", "+5V", "+5VA"),
)
BOARDS = (NANO, PAPER)
