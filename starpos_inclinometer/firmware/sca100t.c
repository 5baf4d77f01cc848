// SPDX-License-Identifier: Apache-2.0
#include "sca100t.h"

#include "spi.h"

#define RWTR 0x08          // "read and write temperature register": 8 bits of command, then 8 of counts
#define COUNTS_AT_125C 62  // 197 - 1.083 x 125
#define COUNTS_AT_M40C 240 // 197 + 1.083 x 40

// Between two commands CSB must be high for 150 us; they are a sample, at least 20 ms, apart.
bool sca100t_temperature(uint8_t *counts)
{
    spi_select(SPI_MODE_0 | SPI_BY_32, PIN_SCA100T_CS); // 250 kHz, at most 500 kHz
    spi_transfer(RWTR);
    *counts = spi_transfer(0);
    spi_release();
    return *counts >= COUNTS_AT_125C && *counts <= COUNTS_AT_M40C;
}
