// SPDX-License-Identifier: Apache-2.0
#include "spi.h"

#include "board.h"

#define SELECTS (_BV(PIN_AD7730_CS) | _BV(PIN_SCA100T_CS))

// AD7730, POL high: SCLK idles high, data are taken at its rising edge (mode 3); 1 MHz, at most 5 MHz (pulses of
// 100 ns each). SCA100T: SCK idles low, data are taken at its rising edge (mode 0); 250 kHz, at most 500 kHz.
#define CONTROL_AD7730 (_BV(SPE) | _BV(MSTR) | _BV(CPOL) | _BV(CPHA) | _BV(SPR0)) // clock / 8 with SPI2X
#define CONTROL_SCA100T (_BV(SPE) | _BV(MSTR) | _BV(SPR1))                        // clock / 32 with SPI2X

void spi_init(void)
{
    PORTB |= SELECTS | _BV(PB4); // nobody drives MISO between transfers: pull it up
    DDRB |= SELECTS | _BV(PB3) | _BV(PB5);
    SPCR = CONTROL_AD7730;
    SPSR = _BV(SPI2X);
}

// The clock takes its idle level before the chip is selected.
void spi_select_ad7730(void)
{
    SPCR = CONTROL_AD7730;
    PORTB &= ~_BV(PIN_AD7730_CS);
}

void spi_select_sca100t(void)
{
    SPCR = CONTROL_SCA100T;
    PORTB &= ~_BV(PIN_SCA100T_CS);
}

void spi_release(void)
{
    PORTB |= SELECTS;
}

uint8_t spi_transfer(uint8_t byte)
{
    SPDR = byte;
    while (!(SPSR & _BV(SPIF))) {
    }
    return SPDR;
}
