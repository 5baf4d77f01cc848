// SPDX-License-Identifier: Apache-2.0
// The two boards: clocks, pins, registers by one name. The wiring tables are in the package's README.
// BOARD_PAPER is an ATmega8 with AD7730 and SCA100T-D01, BOARD_NANO an Arduino Nano (ATmega328P) with an SCL3300-D01.
#pragma once

#include <avr/io.h>

// SPI: PB3 MOSI, PB4 MISO, PB5 SCK. PB2 is SS, which must be an output while the MCU is the master.
// Pulses: PB0 is ICP1, the shutter; PD3 is INT1, a receiver's pulse per second.
#define PIN_SHUTTER PB0
#define PIN_PPS PD3

#ifdef BOARD_PAPER

#ifndef F_CPU
#define F_CPU 8000000UL // crystal
#endif
#define SENSOR_KIND 0 // the K field of `I`
#define AD7730_CLOCK_HZ 4915200UL // crystal at MCLK
#define PIN_AD7730_CS PB2
#define PIN_SCA100T_CS PB1
#define PIN_AD7730_RDY PD2 // INT0
#define SPI_SELECTS (_BV(PIN_AD7730_CS) | _BV(PIN_SCA100T_CS))

// The sensor's outputs reach AIN(+) through R1 into R2, whose foot and AIN(-) lie at half the supply. The host's
// `divider` parameter is the ratio; the firmware sends codes and needs neither.
#define DIVIDER_R1_OHM 30000UL
#define DIVIDER_R2_OHM 1000UL
#define DIVIDER_RATIO ((DIVIDER_R1_OHM + DIVIDER_R2_OHM) / DIVIDER_R2_OHM)
#define SENSOR_SWING_MV 2000UL // at 30 deg: 4 V/g sin 30 deg
#define ADC_RANGE_UV 80000UL   // mode register RN = 11
_Static_assert(SENSOR_SWING_MV * 1000 < ADC_RANGE_UV * DIVIDER_RATIO, "30 deg must lie within the ADC's range");

#define UART_FRAME (_BV(URSEL) | _BV(UCSZ1) | _BV(UCSZ0)) // 8N1
#define PPS_ENABLE() (MCUCR |= _BV(ISC11) | _BV(ISC10), GICR |= _BV(INT1)) // rising edge

#else // BOARD_NANO

#ifndef F_CPU
#define F_CPU 16000000UL // crystal
#endif
#define SENSOR_KIND 1
#define PIN_SCL3300_CS PB2
#define SPI_SELECTS _BV(PIN_SCL3300_CS)

#define UART_FRAME (_BV(UCSZ01) | _BV(UCSZ00))
#define PPS_ENABLE() (EICRA |= _BV(ISC11) | _BV(ISC10), EIMSK |= _BV(INT1))

// The ATmega8's names of the same registers and interrupts.
#define MCUCSR MCUSR
#define TIMSK TIMSK1
#define TIFR TIFR1
#define TICIE1 ICIE1
#define UBRRH UBRR0H
#define UBRRL UBRR0L
#define UCSRA UCSR0A
#define UCSRB UCSR0B
#define UCSRC UCSR0C
#define UDR UDR0
#define RXCIE RXCIE0
#define RXEN RXEN0
#define TXEN TXEN0
#define UDRIE UDRIE0
#define FE FE0
#define DOR DOR0
#define USART_RXC_vect USART_RX_vect

#endif
