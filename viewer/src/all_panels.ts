/** List of all panels in the order of their tabs. */

import { comparePanel } from './compare/panel';
import { mapPanel } from './map_panel';
import { registerPanel } from './panels';
import { planPanel } from './plan/panel';
import { pointPanel } from './point/panel';
import { usePanel } from './use_panel';
import { viewsPanel } from './views/panel';
import './panel_parts.css';

for (const panel of [mapPanel, pointPanel, viewsPanel, comparePanel, planPanel, usePanel]) registerPanel(panel);
