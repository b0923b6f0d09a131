/** The panel of exports: files of the view, and lines of code for other maps. */

import { mountDownload } from './download';
import { html } from './dom';
import type { Panel } from './panels';
import { mountUseElsewhere } from './use_elsewhere';
import './use_panel.css';

export const usePanel: Panel = {
  id: 'use',
  title: 'Use',
  mount(container, context) {
    const [download, elsewhere] = [html('section'), html('section')];
    container.append(download, elsewhere);
    const ends = [mountDownload(download, context), mountUseElsewhere(elsewhere, context)];
    return () => {
      for (const end of ends) end();
    };
  },
};
