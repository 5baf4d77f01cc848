// SPDX-License-Identifier: Apache-2.0
// The serial line: whole lines out, whole lines in, 38400 baud 8N1.
#pragma once

#include <stdbool.h>
#include <stdint.h>

#define UART_BAUD 38400UL
#define UART_MAX_COMMAND 16 // bytes with '$' and CR LF; a longer line is dropped

void uart_init(void);
bool uart_send(const char *line, uint8_t length); // false: no room for all of it, and nothing of it is sent
uint8_t uart_command(const char **body);          // bytes between '$' and CR LF; 0 while there is no line
void uart_command_done(void);                     // the next one may come in
