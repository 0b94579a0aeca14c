// uPlot as browsers get it: its minified file, as a module (tests/viewer/test_page_source.py).
import uPlot from "uplot";
export default uPlot;
