// SPDX-License-Identifier: Apache-2.0
// What the firmware does to the parts that their data sheets forbid.
#pragma once

void complain(const char *what); // a string that stays; said once each
const char *complaints(void);    // of all so far, separated by "; "
