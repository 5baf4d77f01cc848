// SPDX-License-Identifier: Apache-2.0
#include "scl3300.h"

#include <util/delay.h>

#include "spi.h"

// Mode 0; 2 MHz, 2 to 4 MHz are recommended.
#define CONTROL (SPI_MODE_0 | SPI_BY_8)
#define POLYNOMIAL 0x1D // x^8 + x^4 + x^3 + x^2 + 1 (section 5.1.6), from all ones, inverted
#define REGISTER 0xFC   // of the first byte: write, address
#define RETURN_STATUS 0x03
#define NORMAL 0x01

static uint8_t asked; // the first byte of the frame before, 0xFF: none

static uint8_t crc(const uint8_t *bytes)
{
    uint8_t sum = 0xFF;
    for (uint8_t i = 0; i < 3; i++) {
        sum ^= bytes[i];
        for (uint8_t bit = 0; bit < 8; bit++)
            sum = sum & 0x80 ? sum << 1 ^ POLYNOMIAL : sum << 1;
    }
    return ~sum;
}

enum scl3300_answer scl3300_frame(uint32_t operation, uint16_t *answer)
{
    uint8_t out[4] = {operation >> 24, operation >> 16, operation >> 8}, in[4];
    uint8_t wanted = asked;
    out[3] = crc(out);
    asked = out[0];
    _delay_us(10); // CSB high between frames (section 5.1.2)
    spi_select(CONTROL, PIN_SCL3300_CS);
    for (uint8_t i = 0; i < 4; i++)
        in[i] = spi_transfer(out[i]);
    spi_release();
    *answer = (uint16_t)in[1] << 8 | in[2];
    if (in[3] != crc(in) || (in[0] & REGISTER) != wanted)
        return SCL3300_WRONG;
    return (in[0] & RETURN_STATUS) == NORMAL ? SCL3300_GOOD : SCL3300_FAILING;
}
