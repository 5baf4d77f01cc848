// SPDX-License-Identifier: Apache-2.0
#include "uart.h"

#include <avr/interrupt.h>
#include <avr/io.h>

#include "board.h"

#define RING 128 // a sample and two answers
#define MASK (RING - 1)
_Static_assert((RING & MASK) == 0, "the ring's size must be a power of two");

static volatile uint8_t ring[RING];
static volatile uint8_t head; // written by uart_send
static volatile uint8_t tail; // written by the interrupt

static char input[UART_MAX_COMMAND];
static volatile uint8_t input_length; // 0 outside of a line
static volatile bool input_complete;

void uart_init(void)
{
    UBRRH = 0;
    UBRRL = F_CPU / 16 / UART_BAUD - 1; // 12 at 8 MHz, 25 at 16 MHz: 38462 baud
    UCSRC = UART_FRAME;
    UCSRB = _BV(RXCIE) | _BV(RXEN) | _BV(TXEN);
}

bool uart_send(const char *line, uint8_t length)
{
    uint8_t at = head;
    if (length > ((tail - at - 1) & MASK))
        return false;
    while (length--) {
        ring[at] = *line++;
        at = (at + 1) & MASK;
    }
    head = at;
    UCSRB |= _BV(UDRIE); // the interrupt that may come in between changes no other bit of it
    return true;
}

ISR(USART_UDRE_vect)
{
    uint8_t at = tail;
    if (at == head) {
        UCSRB &= ~_BV(UDRIE);
        return;
    }
    UDR = ring[at];
    tail = (at + 1) & MASK;
}

ISR(USART_RXC_vect)
{
    bool broken = UCSRA & (_BV(FE) | _BV(DOR));
    char byte = UDR;
    uint8_t length = input_length;
    if (input_complete)
        return; // a host waits for its answer
    if (broken)
        length = 0;
    else if (byte == '$')
        length = 1;
    else if (length == UART_MAX_COMMAND - 1 && byte != '\n')
        length = 0;
    else if (length)
        length++;
    if (length) {
        input[length - 1] = byte;
        input_complete = byte == '\n';
    }
    input_length = length;
}

uint8_t uart_command(const char **body)
{
    if (!input_complete)
        return 0;
    uint8_t length = input_length;
    if (length < 4 || input[length - 2] != '\r') {
        uart_command_done();
        return 0;
    }
    *body = input + 1;
    return length - 3;
}

void uart_command_done(void)
{
    input_length = 0;
    input_complete = false;
}
