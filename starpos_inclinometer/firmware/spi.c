// SPDX-License-Identifier: Apache-2.0
#include "spi.h"

void spi_init(void)
{
    PORTB |= SPI_SELECTS | _BV(PB4); // nobody drives MISO between transfers: pull it up
    DDRB |= SPI_SELECTS | _BV(PB3) | _BV(PB5);
    SPCR = SPI_MODE_0;
    SPSR = _BV(SPI2X);
}

// The clock takes its idle level before the chip is selected.
void spi_select(uint8_t control, uint8_t pin)
{
    SPCR = control;
    PORTB &= ~_BV(pin);
}

void spi_release(void)
{
    PORTB |= SPI_SELECTS;
}

uint8_t spi_transfer(uint8_t byte)
{
    SPDR = byte;
    while (!(SPSR & _BV(SPIF))) {
    }
    return SPDR;
}
