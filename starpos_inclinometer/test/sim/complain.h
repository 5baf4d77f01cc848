// SPDX-License-Identifier: Apache-2.0
// Records what the firmware does to the parts against their data sheets.
#pragma once

void complain(const char *what); // records a sentence, each only once
const char *complaints(void);    // all sentences so far, separated by "; "
