// SPDX-License-Identifier: Apache-2.0
// The starpos inclinometer: an MCU between a sensor and a serial line (PROTOCOL.md); board.h has the two boards.
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "board.h"
#include "clock.h"
#include "frame.h"
#include "front.h"
#include "pulses.h"
#include "sampler.h"
#include "spi.h"
#include "uart.h"

#define PROTOCOL_VERSION 2
#define FIRMWARE_VERSION 0x0200 // 2.0
#define UNIT_ADDRESS ((const uint32_t *)0) // in the EEPROM; erased: no serial number

enum reason { WRONG_CRC = 1, UNKNOWN = 2, OUT_OF_RANGE = 3 };

static bool send_identity(void)
{
    uint32_t unit = eeprom_read_dword(UNIT_ADDRESS);
    frame_begin('I');
    frame_field(PROTOCOL_VERSION, 1);
    frame_field(FIRMWARE_VERSION, 2);
    frame_field(unit == UINT32_MAX ? 0 : unit, 4);
    frame_field(sampler_rate_hz(), 1);
    frame_field(sampler_delay_ms(), 2);
    frame_field(SENSOR_KIND, 1);
    return frame_send();
}

static bool send_refusal(enum reason reason)
{
    frame_begin('N');
    frame_field(reason, 1);
    return frame_send();
}

static bool obey(const char *body, uint8_t length)
{
    uint16_t rate;
    if (length == 1 && body[0] == 'Q')
        return send_identity();
    if (length != 4 || body[0] != 'R' || body[1] != ',' || !frame_parse(body + 2, 2, &rate))
        return send_refusal(UNKNOWN);
    if (rate < SAMPLER_MIN_HZ || rate > SAMPLER_MAX_HZ)
        return send_refusal(OUT_OF_RANGE);
    sampler_set_rate(rate);
    return send_identity();
}

static void poll_commands(void)
{
    const char *line;
    uint8_t length = uart_command(&line);
    bool done = true;
    if (!length)
        return;
    enum frame_error error = frame_check(line, length);
    if (error == FRAME_GOOD)
        done = obey(line, length - 5);
    else if (error == FRAME_WRONG_CRC)
        done = send_refusal(WRONG_CRC);
    if (done) // otherwise again, once there is room for the answer
        uart_command_done();
}

static void sleep_until_interrupt(uint32_t since_ms)
{
    const char *line;
    cli();
    if (clock_ms() == since_ms && !front_pending() && !uart_command(&line)) {
        sleep_enable();
        sei();
        sleep_cpu(); // the instruction after sei() is executed before any interrupt
        sleep_disable();
    }
    sei();
}

int main(void)
{
    wdt_enable(WDTO_250MS);
    bool after_watchdog = MCUCSR & _BV(WDRF);
    MCUCSR = 0;
    clock_init();
    uart_init();
    spi_init();
    pulses_init();
    set_sleep_mode(SLEEP_MODE_IDLE);
    sampler_init(after_watchdog);
    sei();
    send_identity();
    for (;;) {
        uint32_t now = clock_ms();
        wdt_reset();
        poll_commands();
        sampler_poll();
        pulses_poll(now);
        sleep_until_interrupt(now);
    }
}
