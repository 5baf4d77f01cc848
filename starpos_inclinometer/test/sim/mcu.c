// SPDX-License-Identifier: Apache-2.0
#include "mcu.h"

#include <string.h>

#include "avr_eeprom.h"
#include "avr_ioport.h"
#include "avr_uart.h"
#include "complain.h"
#include "sim_avr.h"
#include "sim_elf.h"

// Addresses in data space (data sheets, register summaries), and where an endless loop has room.
struct chip {
    const char *name;
    uint32_t hz;
    uint16_t ubrrl, ucsra, spcr, spsr, spdr, mcucsr, divisor, loop;
};
static const struct chip CHIPS[] = {
    [PAPER] = {"atmega8", 8000000, 0x29, 0x2B, 0x2D, 0x2E, 0x2F, 0x54, 12, 0x1FF0},
    [NANO] = {"atmega328p", 16000000, 0xC4, 0xC0, 0x4C, 0x4D, 0x4E, 0x54, 25, 0x7FF0},
};
#define U2X 0x02
#define SPIF 0x80
#define PIN_AD7730_CS 2
#define PIN_SCA100T_CS 1
#define PIN_RDY 2
#define MODE_3 0x0C // CPOL, CPHA
#define PIN_SCL3300_CS 2
#define PIN_SHUTTER 0
#define PIN_PPS 3
#define BOUNCE_S 0.2e-3
#define PPS_S 0.1 // how long a receiver's pulse lasts

struct mcu mcu;

static avr_t *avr;
static const struct chip *chip;
static enum board board;
static avr_irq_t *rdy, *shutter, *pps;
static bool ad7730_selected;
static char input[4096];
static size_t input_length;
static bool input_running;

double mcu_now(void)
{
    return (double)avr->cycle / chip->hz;
}

static avr_cycle_count_t cycle_at(double seconds)
{
    return seconds * chip->hz + 1;
}

// The converter's next event, as a timer of the simulated MCU.

static avr_cycle_count_t on_adc(avr_t *which, avr_cycle_count_t when, void *unused);

static void follow_adc(void)
{
    avr_raise_irq(rdy, !mcu.adc.ready);
    double next = adc_next_event(&mcu.adc);
    avr_cycle_timer_cancel(avr, on_adc, NULL);
    if (next) {
        avr_cycle_count_t at = cycle_at(next);
        avr_cycle_timer_register(avr, at > avr->cycle ? at - avr->cycle : 1, on_adc, NULL);
    }
}

static avr_cycle_count_t on_adc(avr_t *which, avr_cycle_count_t when, void *unused)
{
    (void)which, (void)when, (void)unused;
    adc_event(&mcu.adc, &mcu.sensor, mcu_now());
    follow_adc();
    return 0;
}

// SPI master. simavr's own takes 100 us a byte whatever the clock, and tells nobody the mode.

static int spi_divisor(void)
{
    static const int DIVISORS[] = {4, 16, 64, 128};
    return DIVISORS[avr->data[chip->spcr] & 3] / (avr->data[chip->spsr] & 1 ? 2 : 1);
}

static avr_cycle_count_t on_spi(avr_t *which, avr_cycle_count_t when, void *unused)
{
    (void)which, (void)when, (void)unused;
    uint8_t out = avr->data[chip->spdr], in = 0xFF;
    unsigned mode = avr->data[chip->spcr] & MODE_3;
    if (ad7730_selected && mcu.sensor.selected)
        complain("two chips selected at a time");
    if (ad7730_selected) {
        if (mode != MODE_3)
            complain("AD7730 in another SPI mode than 3");
        in = adc_transfer(&mcu.adc, out, mcu_now());
        follow_adc();
    } else if (mcu.sensor.selected) {
        if (mode != 0)
            complain("SCA100T in another SPI mode than 0");
        if (chip->hz / spi_divisor() > 500000)
            complain("SCA100T clocked faster than 500 kHz");
        in = sensor_transfer(&mcu.sensor, out);
    } else if (mcu.scl3300.selected) {
        if (mode != 0)
            complain("SCL3300 in another SPI mode than 0");
        if (chip->hz / spi_divisor() > 4000000)
            complain("SCL3300 clocked faster than 4 MHz");
        in = scl3300_transfer(&mcu.scl3300, out, mcu_now());
    } else {
        complain("an SPI transfer to nobody");
    }
    avr->data[chip->spdr] = in;
    avr->data[chip->spsr] |= SPIF;
    return 0;
}

static void spi_write(avr_t *which, avr_io_addr_t address, uint8_t value, void *unused)
{
    (void)unused;
    which->data[address] = value;
    which->data[chip->spsr] &= ~SPIF;
    avr_cycle_timer_register(which, 8 * spi_divisor(), on_spi, NULL);
}

static uint8_t spi_read(avr_t *which, avr_io_addr_t address, void *unused)
{
    (void)unused;
    which->data[chip->spsr] &= ~SPIF;
    return which->data[address];
}

static void on_ad7730_cs(struct avr_irq_t *irq, uint32_t level, void *unused)
{
    (void)irq, (void)unused;
    ad7730_selected = !(level & 1);
}

static void on_sca100t_cs(struct avr_irq_t *irq, uint32_t level, void *unused)
{
    (void)irq, (void)unused;
    sensor_select(&mcu.sensor, !(level & 1), mcu_now());
}

static void on_scl3300_cs(struct avr_irq_t *irq, uint32_t level, void *unused)
{
    (void)irq, (void)unused;
    scl3300_select(&mcu.scl3300, !(level & 1), &mcu.sensor, mcu_now());
}

// Pulses: the shutter's contact, low while it is closed, and the receiver's second.

static struct {
    unsigned edges; // of the contact, still to come
    double seconds, every_s;
    bool high;
} pulses;

// simavr would let the pull-up win at each write to the port, if it were not told of the contact.
static void set_shutter(bool high)
{
    avr_ioport_external_t contact = {.name = 'B', .mask = 1 << PIN_SHUTTER, .value = high << PIN_SHUTTER};
    avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL('B'), &contact);
    avr_raise_irq(shutter, high);
}

static avr_cycle_count_t on_shutter(avr_t *which, avr_cycle_count_t when, void *unused)
{
    (void)which, (void)unused;
    // The last edge opens it, the one before that was the end of the bounces, with the contact closed.
    pulses.edges--;
    set_shutter(!(pulses.edges & 1));
    if (!pulses.edges)
        return 0;
    return when + (avr_cycle_count_t)((pulses.edges == 1 ? pulses.seconds : BOUNCE_S) * chip->hz);
}

void mcu_shutter(double after_s, double seconds, unsigned bounces)
{
    pulses.edges = 2 * bounces + 2;
    pulses.seconds = seconds;
    avr_cycle_timer_register(avr, after_s * chip->hz + 1, on_shutter, NULL);
}

static avr_cycle_count_t on_pps(avr_t *which, avr_cycle_count_t when, void *unused)
{
    (void)which, (void)unused;
    pulses.high = !pulses.high;
    avr_raise_irq(pps, pulses.high);
    return when + (avr_cycle_count_t)((pulses.high ? PPS_S : pulses.every_s - PPS_S) * chip->hz);
}

void mcu_pps(double after_s, double every_s)
{
    avr_cycle_timer_cancel(avr, on_pps, NULL);
    pulses.high = false;
    avr_raise_irq(pps, 0);
    pulses.every_s = every_s;
    if (every_s)
        avr_cycle_timer_register(avr, after_s * chip->hz + 1, on_pps, NULL);
}

// UART.

static uint32_t byte_cycles(void)
{
    return 16 * (chip->divisor + 1) * 10;
}

static void on_sent(struct avr_irq_t *irq, uint32_t byte, void *unused)
{
    (void)irq, (void)unused;
    if (avr->data[chip->ubrrl] != chip->divisor || (avr->data[chip->ucsra] & U2X))
        complain("UART at another speed than 38400 baud");
    if (byte == '$')
        mcu.line_at = mcu_now();
    mcu.sent(byte);
}

static avr_cycle_count_t on_input(avr_t *which, avr_cycle_count_t when, void *unused)
{
    (void)which, (void)unused;
    input_running = input_length > 0;
    if (!input_running)
        return 0;
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), (uint8_t)input[0]);
    memmove(input, input + 1, --input_length);
    return when + byte_cycles();
}

size_t mcu_receive(const char *bytes, size_t count)
{
    if (count > sizeof input - input_length)
        count = sizeof input - input_length;
    memcpy(input + input_length, bytes, count);
    input_length += count;
    if (input_length && !input_running) {
        input_running = true;
        avr_cycle_timer_register(avr, byte_cycles(), on_input, NULL);
    }
    return count;
}

// Resets. simavr forgets all timers at one, and calls this module.

static void on_reset(struct avr_io_t *io)
{
    (void)io;
    mcu.reset_at = mcu_now();
    ad7730_selected = false;
    mcu.scl3300.selected = false;
    pulses.edges = 0;
    set_shutter(true);
    input_length = 0;
    input_running = false;
    adc_interrupt(&mcu.adc);
    follow_adc();
}

void mcu_reset(bool power)
{
    if (power) {
        adc_power_on(&mcu.adc);
        scl3300_power_on(&mcu.scl3300, mcu_now());
        mcu.sensor.selected = false;
    }
    uint8_t causes = avr->data[chip->mcucsr]; // those before stay until they are cleared
    avr_reset(avr);
    avr->data[chip->mcucsr] = power ? 0x01 : causes | 0x02; // PORF, EXTRF
}

void mcu_hang(void)
{
    avr->sreg[S_I] = 0;
    avr->pc = chip->loop;
    avr->state = cpu_Running;
}

bool mcu_init(const char *elf, enum board which, uint32_t unit)
{
    static avr_io_t module = {.kind = "board", .reset = on_reset};
    elf_firmware_t firmware = {0};
    if (elf_read_firmware(elf, &firmware) != 0 || !firmware.flashsize)
        return false;
    board = which;
    chip = &CHIPS[board];
    if (firmware.flashsize > chip->loop)
        return false;
    avr = avr_make_mcu_by_name(chip->name);
    avr_init(avr);
    avr->frequency = chip->hz;
    avr_load_firmware(avr, &firmware);
    avr->flash[chip->loop] = 0xFF; // rjmp .-2
    avr->flash[chip->loop + 1] = 0xCF;
    avr_eeprom_desc_t serial = {.ee = (uint8_t *)&unit, .offset = 0, .size = sizeof unit};
    avr_ioctl(avr, AVR_IOCTL_EEPROM_SET, &serial);

    avr->io[AVR_DATA_TO_IO(chip->spdr)].w.c = spi_write;
    avr->io[AVR_DATA_TO_IO(chip->spdr)].r.c = spi_read;
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(AVR_UART_FLAG_POLL_SLEEP | AVR_UART_FLAG_STDIO);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_t *portb = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 0);
    if (board == NANO) {
        avr_irq_register_notify(portb + PIN_SCL3300_CS, on_scl3300_cs, NULL);
    } else {
        avr_irq_register_notify(portb + PIN_AD7730_CS, on_ad7730_cs, NULL);
        avr_irq_register_notify(portb + PIN_SCA100T_CS, on_sca100t_cs, NULL);
    }
    shutter = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), PIN_SHUTTER);
    pps = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), PIN_PPS);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_sent, NULL);
    rdy = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), PIN_RDY);
    avr_register_io(avr, &module);

    sensor_init(&mcu.sensor);
    mcu_reset(true);
    return true;
}

static void no_sleep(avr_t *which, avr_cycle_count_t cycles)
{
    (void)which;
    mcu.asleep += (double)cycles / chip->hz; // the caller waits for the time to come, not this
}

bool mcu_run(double until)
{
    avr->sleep = no_sleep;
    avr_cycle_count_t end = cycle_at(until);
    while (avr->cycle < end) {
        int state = avr_run(avr);
        if (state == cpu_Crashed || state == cpu_Done)
            return false;
        if (mcu.hang_at && mcu.adc.left == mcu.hang_at && !mcu.adc.reading) {
            mcu.hang_at = 0;
            mcu_hang();
        }
    }
    return true;
}
