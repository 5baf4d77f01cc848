// SPDX-License-Identifier: Apache-2.0
#include "ad7730.h"

#include <avr/interrupt.h>

#include "spi.h"

// POL high: mode 3; 1 MHz, at most 5 MHz (pulses of 100 ns each).
#define CONTROL (SPI_MODE_3 | SPI_BY_8)

static volatile bool ready;

ISR(INT0_vect)
{
    ready = true;
}

static void write(uint8_t address, uint32_t value, uint8_t bytes)
{
    spi_select(CONTROL, PIN_AD7730_CS);
    spi_transfer(AD7730_WRITE | address);
    while (bytes--)
        spi_transfer(value >> (8 * bytes));
    spi_release();
}

static uint32_t read(uint8_t address, uint8_t bytes)
{
    uint32_t value = 0;
    spi_select(CONTROL, PIN_AD7730_CS);
    spi_transfer(AD7730_READ | address);
    while (bytes--)
        value = value << 8 | spi_transfer(0); // zeros: ones at DIN would count towards a reset
    spi_release();
    return value;
}

void ad7730_init(void)
{
    MCUCR |= _BV(ISC01); // INT0 at the falling edge of RDY
    GICR |= _BV(INT0);
}

void ad7730_reset(void)
{
    spi_select(CONTROL, PIN_AD7730_CS);
    for (uint8_t i = 0; i < 5; i++) // at least 32 clocks with DIN high, wherever the interface stood
        spi_transfer(0xFF);
    spi_release();
}

void ad7730_configure(void)
{
    write(AD7730_FILTER, AD7730_FILTER_WORD, 3);
}

void ad7730_start(uint16_t mode)
{
    write(AD7730_MODE, mode | AD7730_MODE_INPUT, 2);
    // Only now: until the mode is written, the conversions before this one may end.
    GIFR = _BV(INTF0);
    ready = false;
}

bool ad7730_ready(void)
{
    return ready;
}

bool ad7730_no_reference(void)
{
    return read(AD7730_STATUS, 1) & AD7730_STATUS_NOREF;
}

bool ad7730_runs(uint16_t mode)
{
    return read(AD7730_MODE, 2) == (mode | AD7730_MODE_INPUT);
}

uint32_t ad7730_data(void)
{
    return read(AD7730_DATA, 3);
}
