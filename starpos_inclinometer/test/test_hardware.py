# SPDX-License-Identifier: Apache-2.0
"""The drawings: their nets are the firmware's pins, and parts lists and pictures are theirs."""

import csv
import re
from collections import defaultdict
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1]
HARDWARE = PACKAGE / "hardware"
# Pins of an Arduino Nano that have the names of ports (Arduino's table).
NANO_PORTS = {f"D{i}": f"PD{i}" for i in range(8)} | {f"D{8 + i}": f"PB{i}" for i in range(6)}
MCU = {"nano": "A1", "paper": "U1"}


def _expressions(text):
    """Read an S-expression as nested lists."""
    stack = [[]]
    for token in re.findall(r'"(?:\\.|[^"\\])*"|[()]|[^\s()]+', text):
        if token == "(":
            stack.append([])
        elif token == ")":
            done = stack.pop()
            stack[-1].append(done)
        else:
            stack[-1].append(token.strip('"'))
    assert len(stack) == 1
    return stack[0][0]


def _all(node, name):
    return [each for each in node if isinstance(each, list) and each[:1] == [name]]


def _place(node):
    return tuple(float(value) for value in _all(node, "at")[0][1:3])


class Netlist:
    """What a .kicad_sch connects: labels and crosses that lie on the ends of pins."""

    def __init__(self, board):
        sheet = _expressions((HARDWARE / f"{board}.kicad_sch").read_text())
        self.version = _all(sheet, "version")[0][1]
        labels = {_place(label): label[1] for label in _all(sheet, "label")}
        crosses = {_place(cross) for cross in _all(sheet, "no_connect")}
        library = {symbol[1]: symbol for symbol in _all(_all(sheet, "lib_symbols")[0], "symbol")}
        # Net of each (reference, pin's name), and of each (reference, number).
        self.by_name, self.by_number = {}, {}
        self.pins, self.kinds = defaultdict(set), defaultdict(set)
        self.fields = {}
        used = set()
        for part in _all(sheet, "symbol"):
            fields = {field[1]: field[2] for field in _all(part, "property")}
            reference, (x, y) = fields["Reference"], _place(part)
            self.fields[reference] = fields
            for unit in _all(library[_all(part, "lib_id")[0][1]], "symbol"):
                for pin in _all(unit, "pin"):
                    # The library's y points up, the sheet's down.
                    u, v = _place(pin)
                    end = round(x + u, 4), round(y - v, 4)
                    assert end not in used, f"two pins meet at {end}"
                    used.add(end)
                    name, number = (_all(pin, key)[0][1] for key in ("name", "number"))
                    net = labels.get(end)
                    assert (net is None) == (end in crosses), f"{reference} pin {number} has no end"
                    self.by_name[reference, name], self.by_number[reference, number] = net, net
                    if net:
                        self.pins[net].add((reference, number))
                        self.kinds[net].add(pin[1])
        assert used == set(labels) | crosses, "a label or a cross is on no pin"

    def port(self, reference, port):
        """Net of a microcontroller's pin by the name of its port, such as PB0."""
        for (part, name), net in self.by_name.items():
            if part == reference and port in (name.split("/")[0], NANO_PORTS.get(name.split("/")[0])):
                return net
        raise AssertionError(f"{reference} has no pin {port}")

    def across_buffer(self, net):
        """Net behind the gate of a 74x125 whose input is on `net`."""
        for (part, name), other in self.by_name.items():
            if re.fullmatch(r"\dA", name) and other == net:
                return self.by_name[part, name[0] + "Y"]
        raise AssertionError(f"no gate takes {net}")

    def across_part(self, net, reference):
        """The other net of a part with two pins."""
        return next(self.by_number[reference, n] for n in "12" if self.by_number[reference, n] != net)


@pytest.fixture(scope="module", params=["nano", "paper"])
def drawn(request):
    return request.param, Netlist(request.param)


def _firmware_pins(board):
    """Pins of board.h that hold for one board, {PIN_...: port}."""
    text = (PACKAGE / "firmware" / "board.h").read_text()
    common, paper, nano = re.fullmatch(
        r"(.*)#ifdef BOARD_PAPER(.*)#else // BOARD_NANO(.*)", text, re.DOTALL
    ).groups()
    return dict(re.findall(r"#define (PIN_\w+) (P[B-D]\d)", common + (nano if board == "nano" else paper)))


def test_the_documents_picture_shows_every_part_and_net(drawn):
    board, nets = drawn
    picture = PACKAGE.parent / "docs" / "images" / f"board_{board}.svg"
    shown = set(re.findall(r">([^<>]+)</text>", picture.read_text()))
    parts = {reference for reference in nets.fields if not reference.startswith("#")}
    assert parts | set(nets.pins) <= {word for text in shown for word in [text, *text.split()]}


def test_kicad_6_can_read_the_version(drawn):
    assert drawn[1].version == "20211123"


def test_pins_of_the_firmware_reach_what_they_drive(drawn):
    board, nets = drawn
    pins = {name: nets.port(MCU[board], port) for name, port in _firmware_pins(board).items()}
    shutter = nets.by_name["U3", "VO"]
    # Through the optocoupler from the contact, and through a gate from the receiver.
    contact = nets.by_number["J2", "1"]
    assert nets.across_part(contact, "D1") == nets.by_name["U3", "K"]
    pulse = nets.across_buffer(nets.across_part(nets.by_number["J3", "1"], "R3"))
    expected = {"PIN_SHUTTER": shutter, "PIN_PPS": pulse}
    if board == "nano":
        assert nets.by_name["U1", "CSB"] == nets.across_buffer(pins["PIN_SCL3300_CS"])
        expected["PIN_SCL3300_CS"] = pins["PIN_SCL3300_CS"]
    else:
        expected["PIN_AD7730_CS"] = nets.by_name["U2", "~{CS}"]
        expected["PIN_AD7730_RDY"] = nets.by_name["U2", "~{RDY}"]
        expected["PIN_SCA100T_CS"] = nets.by_name["U5", "CSB"]
    assert pins == expected


def test_spi_is_on_the_pins_of_the_hardware(drawn):
    board, nets = drawn
    mosi, miso, sck = (nets.port(MCU[board], port) for port in ("PB3", "PB4", "PB5"))
    if board == "nano":
        assert nets.by_name["U1", "MOSI"] == nets.across_buffer(mosi)
        assert nets.by_name["U1", "SCK"] == nets.across_buffer(sck)
        assert nets.across_buffer(nets.by_name["U1", "MISO"]) == miso
        # While the sensor is not selected its gate leaves MISO alone: the ATmega pulls it up to 5 V.
        assert nets.by_name["U4", "2~{OE}"] == nets.port("A1", "PB2")
        return
    assert {nets.by_name["U2", name] for name in ("DIN", "DOUT", "SCLK")} == {mosi, miso, sck}
    for reference, names in {"U2": ("DIN", "DOUT", "SCLK"), "U5": ("MOSI", "MISO", "SCK")}.items():
        assert tuple(nets.by_name[reference, name] for name in names) == (mosi, miso, sck)
    assert nets.by_number["J1", "5"] == nets.port("U1", "PD1")
    assert nets.by_number["J1", "4"] == nets.port("U1", "PD0")


def test_no_five_volts_reach_the_scl3300():
    nets = Netlist("nano")
    reached = {net for (part, _), net in nets.by_name.items() if part == "U1"}
    for net in reached - {"GND", "+3V3"}:
        # Behind each is the sensor itself, a capacitor, a resistor to ground, or a gate fed with 3.3 V.
        for part, number in nets.pins[net]:
            driven = number in ("3", "6", "8", "11")
            assert part != "U4" or not driven
            assert part[0] in "UCR" and part not in ("U3",)
            assert part != "R6" or nets.across_part(net, part) == "GND"
    assert nets.by_name["U2", "VCC"] == nets.by_name["U1", "VDD"] == "+3V3"


def test_every_net_joins_two_pins_and_has_one_driver(drawn):
    _, nets = drawn
    for net, pins in nets.pins.items():
        assert len(pins) > 1, f"{net} ends at {pins}"
        if "power_in" in nets.kinds[net]:
            assert "power_out" in nets.kinds[net], f"nothing feeds {net}"
        if "output" in nets.kinds[net]:
            assert not nets.kinds[net] & {"power_out", "tri_state"}, f"two parts drive {net}"


def test_supplies_have_a_capacitor_a_chip(drawn):
    _, nets = drawn
    for net in ("+5V", "+3V3", "+5VA"):
        fed = {
            part for part, number in nets.pins[net] if part[0] == "U" and nets.fields[part]["MPN"] != "6N139"
        }
        fed = {
            part for part in fed if any(nets.by_name.get((part, n)) == net for n in ("VCC", "VDD", "AVDD"))
        }
        decoupled = {part for part, _ in nets.pins[net] if part[0] == "C"}
        assert len(decoupled) >= len(fed), f"{net}: {fed}"


def test_dividers_are_the_firmwares():
    nets = Netlist("paper")
    text = (PACKAGE / "firmware" / "board.h").read_text()
    r1, r2 = (int(ohm) for ohm in re.findall(r"DIVIDER_R\d_OHM (\d+)UL", text))
    for output, upper, lower in (("OUT_1", "R8", "R9"), ("OUT_2", "R11", "R12")):
        tap = nets.across_part(nets.by_name["U5", output], upper)
        assert nets.across_part(tap, lower) == nets.by_name["U6", "OUT"]
        values = [nets.fields[part]["Value"].split()[0] for part in (upper, lower)]
        assert values == [f"{ohm // 1000}k" for ohm in (r1, r2)]


def test_parts_lists_have_every_part_and_its_number(drawn):
    board, nets = drawn
    with open(HARDWARE / f"{board}_parts.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    listed = {
        reference: row["manufacturer_part_number"] for row in rows for reference in row["references"].split()
    }
    assert all(listed.values())
    assert listed == {part: f["MPN"] for part, f in nets.fields.items() if not part.startswith("#")}
    assert all(int(row["quantity"]) == len(row["references"].split()) for row in rows)
