// SPDX-License-Identifier: Apache-2.0
// The SPI bus: one of its two chips is selected at a time.
#pragma once

#include <stdint.h>

void spi_init(void);
void spi_select_ad7730(void);
void spi_select_sca100t(void);
void spi_release(void);
uint8_t spi_transfer(uint8_t byte); // sends and receives
