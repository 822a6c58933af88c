// SPDX-License-Identifier: Apache-2.0
'use strict';

/* Shows the anatomy of a report; named for tests. */
window.needleAnatomyView = new needleAnatomy.View(document.querySelector('.solid'), JSON.parse(document.getElementById('frames').textContent));
