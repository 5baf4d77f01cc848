// SPDX-License-Identifier: Apache-2.0
// The SPI bus: one of its chips is selected at a time.
#pragma once

#include <stdint.h>

#include "board.h"

// Mode 0: SCK idles low; mode 3: high; data are taken at the rising edge in both.
#define SPI_MODE_0 (_BV(SPE) | _BV(MSTR))
#define SPI_MODE_3 (_BV(SPE) | _BV(MSTR) | _BV(CPOL) | _BV(CPHA))
#define SPI_BY_8 _BV(SPR0)  // share of the MCU's clock, with SPI2X
#define SPI_BY_32 _BV(SPR1)

void spi_init(void);
void spi_select(uint8_t control, uint8_t pin); // mode and clock, and the chip's pin of port B
void spi_release(void);
uint8_t spi_transfer(uint8_t byte); // sends and receives
