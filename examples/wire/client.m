% The wire of the twin in MATLAB (R2020b or later): tcpclient, jsonencode and jsondecode, no flexdt.
%
%   client                      % the twin on this computer
%   client('192.168.1.7', 55000)
%
% Moves the stage, asks for a projection and shows it. Not run by the tests: no MATLAB there; its
% lines on the wire are (tests/clients/test_wire_examples.py sends them).
function client(host, port)
    if nargin < 1, host = '127.0.0.1'; end
    if nargin < 2, port = 55000; end
    twin = tcpclient(host, port, 'Timeout', 60);
    configureTerminator(twin, 'LF');

    call(twin, 'session.hello', struct('protocol', '1.0', 'client', 'MATLAB'));
    call(twin, 'sample.set', struct('name', 'normal-5'));
    targets = struct('tra_obj', 0, 'mag_obj', 600, 'rot_obj', 45);
    moved = call(twin, 'axes.move', struct('targets', targets, 'wait', true));
    fprintf('the motion took %.2f s of the twin''s time\n', moved.duration_s);

    answer = call(twin, 'projection.get', struct('kind', 'line_integral', 'binning', 4));
    image = decode(answer);
    fprintf('%d x %d, largest line integral %.3f\n', size(image), max(image(:)));
    imagesc(image); axis image; colormap(flipud(gray)); colorbar;
end

function result = call(twin, method, params)
% Send a request and return its result, passing over events; errors become MATLAB errors.
    persistent count
    if isempty(count), count = 0; end
    count = count + 1;
    request = struct('jsonrpc', '2.0', 'id', count, 'method', method, 'params', params);
    writeline(twin, jsonencode(request));
    while true
        answer = jsondecode(readline(twin));
        if isfield(answer, 'method'), continue, end          % an event
        if isfield(answer, 'error')
            error('flexdt:refused', '%s: %s (%d)', method, answer.error.message, answer.error.code);
        end
        result = answer.result;
        return
    end
end

function image = decode(answer)
% Little-endian values, row by row: MATLAB counts columns first, hence the transpose.
    types = struct('float32', 'single', 'uint16', 'uint16', 'float64', 'double');
    bytes = matlab.net.base64decode(answer.data);
    values = typecast(uint8(bytes), types.(answer.dtype));
    image = reshape(values, answer.shape(2), answer.shape(1)).';
end
